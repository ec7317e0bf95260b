"""Docstrings of public names: all there, in numpydoc's form, with examples that run."""

import doctest
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import pytest
from numpydoc.validate import ERROR_MSGS, validate

import tpgmm_datasets
import tpgmm_torch

#: Checks of numpydoc that are not asked for, and why.
LEFT_OUT = {
    "ES01": "a summary may say it all",
    "EX01": "examples stand where a name is used directly",
    "PR01": "methods may name parameters in their sentence; see also project/test_layers.py",
    "PR04": "a row may stand for parameters that are explained elsewhere",
    "PR07": "a type with its shape may say it all",
    "RT01": "a summary may say what comes back",
    "RT03": "a type with its shape may say it all",
    "SA01": "the reference is ordered by concept instead",
    "SS05": "it takes plural nouns for verbs",
    "YD01": "iterators are described as what comes back",
}
ASKED_FOR = set(ERROR_MSGS) - set(LEFT_OUT)
#: What most users meet first: each of these has an example.
SHOWN = {
    "tpgmm_torch": (
        "AbsoluteOrientation AbsolutePosition Canonical Demonstration "
        "Frame RelativeOrientation RelativePosition Robot.from_urdf "
        "Situation Stack TaskParameterizedGMM TaskParameterizedGMM.step"
    ),
    "tpgmm_torch.mixture.block_gaussian_mixture": "BlockGaussianMixture",
    "tpgmm_torch.robots": "Kinematics Poses",
    "tpgmm_torch.alignment": "DynamicTimeWarping LinearTimeNormalization",
    "tpgmm_torch.gaussians": "condition information moment_match product",
    "tpgmm_torch.metrics": "largest_acceleration largest_velocity PoseScorer",
    "tpgmm_tools.paper.sinusoid": "sinusoid",
    "tpgmm_torch.operators.text": "format_operator parse_operator",
    "tpgmm_tools.plotting": "figure",
    "tpgmm_torch.quaternions": "exp product",
    "tpgmm_datasets.situation_files": "read_situations",
    "tpgmm_datasets.tables": "demonstrations_from_frame demonstrations_to_frame",
    "tpgmm_datasets": (
        "FramePose LinkPose Scale describe_lerobot load_lerobot resample save_lerobot trim"
    ),
    "tpgmm_datasets.bottle.skill": "BottleShaking",
}


def module_names() -> Iterator[str]:
    for package in (tpgmm_torch, tpgmm_datasets):
        yield package.__name__
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            yield found.name


MODULES = list(module_names())


def public(module: ModuleType) -> Iterator[str]:
    """The functions, classes and methods that a module defines without an underscore."""
    for name, value in list(vars(module).items()):
        if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(value) or inspect.isclass(value):
            yield f"{module.__name__}.{name}"
        for member, method in vars(value).items() if inspect.isclass(value) else ():
            kinds = classmethod | staticmethod | property
            written = inspect.isfunction(method) and method.__name__ == member  # no lambda
            if not member.startswith("_") and (written or isinstance(method, kinds)):
                yield f"{module.__name__}.{name}.{member}"


def test_the_checks_that_are_left_out_are_few_and_exist():
    assert set(LEFT_OUT) <= set(ERROR_MSGS)
    assert len(ASKED_FOR) > 2 * len(LEFT_OUT)


@pytest.mark.parametrize("module", MODULES)
def test_docstrings_have_the_form_of_numpydoc(module):
    wrong = [
        f"{name}: {code} {message}"
        for name in public(importlib.import_module(module))
        for code, message in validate(name)["errors"]
        if code in ASKED_FOR
    ]
    assert wrong == []


@pytest.mark.parametrize("module", MODULES)
def test_examples_give_what_they_print(module):
    found = doctest.DocTestFinder().find(importlib.import_module(module), module)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS, verbose=False)
    output: list[str] = []
    for example in found:
        runner.run(example, out=output.append)
    assert runner.failures == 0, "".join(output)


@pytest.mark.parametrize("module", SHOWN)
def test_what_users_meet_first_has_an_example(module):
    for name in SHOWN[module].split():
        value = importlib.import_module(module)
        for part in name.split("."):
            value = getattr(value, part)
        assert ">>>" in (value.__doc__ or ""), f"{module}.{name} has no example"
