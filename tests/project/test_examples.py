"""The gallery: every script runs, draws, and keeps what its text says."""

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.robot_zoo import G1_PATH

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[2] / "examples"
SCRIPTS = sorted(path.name for path in FOLDER.glob("plot_*.py"))
RECORDINGS = Path(__file__).parents[3] / "shared" / "data"

#: For each script how many figures it draws, and what its text states, of its variables.
CLAIMS = {
    "plot_01_planar_arm.py": (1, "max(misses) < 2"),
    "plot_02_frames_without_a_robot.py": (
        1,
        "max(misses['both frames']) < 10",
        "misses['box alone'][1] > 333",
        "misses['socket alone'][0] > 333",
    ),
    "plot_03_orientation_sign.py": (
        1,
        "max(errors['four plain numbers']) > 90",
        "max(errors['an orientation']) < 10",
        "max(degrees_off(one).max() for one in recordings) < 17",
    ),
    "plot_04_competing_constraints.py": (1, "shares['grasp'] < 0.05", "shares['shake'] > 0.5"),
    "plot_05_two_hands.py": (
        2,
        "errors['stacked'][1] < 2",
        "errors['stacked'][2] < 0.1",
        "min(e[1] for name, e in errors.items() if name != 'stacked') > 35",
        "min(e[7] for name, e in errors.items() if name != 'stacked') > 5",
    ),
    "plot_06_choosing.py": (
        1,
        "best == 'room and tray'",
        "errors['room and tray'][3] < 25",
        "min(errors['room'] + errors['tray']) > 75",
        "errors['room and tray'][4] > 0.9 * errors['room and tray'][3]",
        "(np.diff(bic)[:2] < 0).all()",
        "abs(bic[3] / bic[2] - 1) < 0.01",
        "max(misses['room and tray'][2:] + misses['tray'][2:]) < 4",
        "misses['room and tray'][1] > 15",
        "errors['tray'][4] > 90",
    ),
    "plot_07_lerobot_dataset.py": (1, "0.5 < error / typical < 2"),
    "plot_08_alignment.py": (
        1,
        "max(s for n, s in spreads.items() if 'warped' in n) < spreads['time stretched'] / 5",
    ),
    "plot_09_covariance_along_the_path.py": (1, "at_end > 3 * at_gate", "0.9 < ratio < 1.1"),
    "plot_10_own_operator.py": (
        1,
        "errors['with the distance'] < 5",
        "errors['joints alone'] > 10",
        "abs(float(change - predicted)) < 1e-9",
    ),
    "plot_11_what_matters.py": (
        1,
        "model.frame_names_ == ('cup', 'tray')",
        "selection.support_.sum() == 3",
        # the cup while the hand rests at it, the tray at the end
        "selection.candidates_[int(selection.relevance_[22].argmax())].frame == 'cup'",
        "selection.candidates_[int(selection.relevance_[-1].argmax())].frame == 'tray'",
    ),
    "plot_12_parts.py": (
        2,
        "segmentation.reasons_ == ('stop', 'stop')",
        "off < 0.3",
        "[len(part.operators) for part in skill.skills] == [2, 3, 2]",
        "skill.frame_names == ('cup', 'tray')",
        "max(least.values()) < 10",
    ),
    "plot_13_two_ways.py": (
        1,
        "ways.labels_.tolist() == [0, 1, 0, 0, 1, 1, 0, 1, 1, 0]",
        "min(passed['two ways']) > 9",
        "np.median(passed['single model']) < 6",
    ),
    "plot_14_corrections.py": (
        1,
        "abs(float(through.joints[np.abs(time - 2).argmin(), 0]) - 0.5) < 0.05",
        "all(abs(float(p.time[0]) - 2.5) < 0.1 for p in placed)",
        "0.05 < float((before.joints - after.joints).max()) < 0.3",
    ),
    "plot_15_few_demonstrations.py": (
        2,
        "strongest[0] > 0.7",
        "strongest['auto'] < 0.01",
        "strongest['many'] < 0.25",
        "errors['auto'][1:].max() < 4",
        "np.median(errors['auto'][0]) > 100",
        "np.median(errors[0][:3]) > 100",
        "errors[0][-1].max() < 4 < errors[0][-2].min()",
    ),
    "plot_16_orientations_far_apart.py": (
        1,
        "errors['quaternion'][:2].max() < 0.6",
        "errors['quaternion'][-1].max() > 45",
        "errors['tangent'].max() < 0.05",
        "degrees[1] < 120 < degrees[2]",
    ),
    "plot_17_new_to_me.py": (
        1,
        "(inside > 1).mean() < 2 / 9",
        "not fails[novelty <= 1].any()",
        "0.05 < fails[novelty > 1].mean() < 0.5",
        "record[:20, 2].max() < 0.5",
        "record[-1, 2] > 1.5",
    ),
    "plot_18_which_goes_first.py": (
        1,
        "np.median(found['the tip first'][..., 0], axis=1).max() < 2",
        "np.median(found['the tip first'][-1, :, 1]) > 90",
        "found['compromise'][:3, :, :2].max() < 5",
        "np.median(found['compromise'][-1, :, 0]) > 50",
        "0 < (found['the tip first'][..., 0] > 20).sum() < 10",
        "np.median(found['the tip first'][2:, :, 2]) > 2.9",
    ),
    "plot_19_contact.py": (
        1,
        "model.operators_[-1].axes == (2,)",
        "max(abs(pressed['with admittance', e] - 8) for e in (-5, 0, 5)) < 0.2",
        "pressed['positions alone', -5] == 0",
        "pressed['positions alone', 5] > 15",
    ),
    "plot_20_obstacles.py": (
        1,
        "distances['alone'].min() < -20",
        "distances['around'].min() > 5",
    ),
    "plot_21_try_again.py": (
        1,
        "(np.diff(progress) < 0).sum() == 2",
        "np.linalg.norm(cup - tray) < 0.01",
        "np.linalg.norm(hand - START) < 0.02",
        "set(status) == {'running', 'waiting'}",
    ),
}


@pytest.fixture
def pyplot(monkeypatch):
    """Figures are kept, not shown; there may be no display."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    monkeypatch.setattr(pyplot, "show", lambda: None)
    pyplot.close("all")
    yield pyplot
    pyplot.close("all")


def run(script, monkeypatch, *arguments):
    """The variables of a script after it has run."""
    monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
    return runpy.run_path(str(FOLDER / script))


def drawn(figure) -> bool:
    """Whether there is more than background in a figure."""
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    return float((pixels < 250).any(axis=-1).mean()) > 0.02


def test_the_gallery_has_the_examples_that_are_checked_here():
    assert list(CLAIMS) == SCRIPTS
    for script in SCRIPTS:
        text = (FOLDER / script).read_text(encoding="utf-8")
        assert "\n# %%\n" in text, script
        title, underline = text.splitlines()[1:3]
        assert underline == "=" * len(title), script


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_picture_of_the_gallery_is_in_the_one_style(script):
    text = (FOLDER / script).read_text(encoding="utf-8")
    assert text.index("plt.style.use(STYLE)") < text.index("plt.subplots(")


@pytest.mark.parametrize(
    "folder", ["examples", "docs/pictures", "tpgmm_torch", "datasets", "policies"]
)
def test_no_picture_has_colours_of_matplotlib(folder):
    for path in (FOLDER.parent / folder).rglob("*.py"):
        found = re.findall(
            r"""["'](?:tab:\w+|C\d|red|green|blue)["']""", path.read_text("utf-8")
        )
        assert not found, f"{path.name}: {found}; take those of tpgmm_tools.plotting"


@pytest.mark.parametrize("script", SCRIPTS)
def test_an_example_draws_and_its_text_is_true(script, pyplot, monkeypatch):
    figures, *claims = CLAIMS[script]
    variables = run(script, monkeypatch)
    for claim in claims:
        assert eval(claim, {"np": np} | variables), claim
    numbers = pyplot.get_fignums()
    assert len(numbers) == figures
    assert all(drawn(pyplot.figure(number)) for number in numbers)


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the recordings are not here")
@pytest.mark.filterwarnings("ignore:left on linear time")
def test_a_real_recording_can_be_given(pyplot, monkeypatch):
    variables = run("plot_07_lerobot_dataset.py", monkeypatch, RECORDINGS / "g1_bottle")
    assert len(variables["demonstrations"]) == 10
    assert 0 < variables["error"] < 1
    assert drawn(pyplot.gcf())


def test_the_model_hits_more_softly_than_position_control():
    from tests.support.skills import small_bottle

    example = runpy.run_path(str(FOLDER / "torque_control.py"))
    env = example["BottleTorqueEnv"](fps=50, obstacle=1.0, episode_length=120)
    soft, stiff = (
        example["episode"](env, small_bottle(), soft, 0)["peak_contact_N"]
        for soft in (True, False)
    )
    assert 0 < soft < 0.5 * stiff


def test_a_tracker_takes_the_controls_of_least_cost():
    """Those of scipy's least squares over the controls of all ticks at once."""
    from scipy.linalg import solve_discrete_are
    from scipy.optimize import minimize

    example = runpy.run_path(str(FOLDER / "linear_quadratic_tracking.py"))
    rng, dt, effort = np.random.default_rng(0), 0.1, 10.0
    joints, roots = rng.normal(size=(6, 2)), 0.1 * rng.normal(size=(6, 2, 3))
    covariance = roots @ roots.transpose(0, 2, 1)
    gains, feedforward = example["track"](joints, covariance, dt, effort)
    a, b = example["double_integrator"](2, dt)
    precision = np.zeros((6, 4, 4))
    precision[:, :2, :2] = np.linalg.inv(covariance)
    targets = np.hstack((joints, np.diff(joints, axis=0, append=joints[-1:]) / dt))
    after = solve_discrete_are(a, b, precision[-1], np.eye(2) / effort**2)
    start = rng.normal(size=4)

    def cost(controls):
        state, total = start, 0.0
        for q, target, control in zip(precision, targets, controls.reshape(6, 2), strict=True):
            total += (state - target) @ q @ (state - target) + control @ control / effort**2
            state = a @ state + b @ control
        return total + (state - targets[-1]) @ after @ (state - targets[-1])

    state, controls = start, []
    for gain, constant in zip(gains, feedforward, strict=True):
        controls.append(constant - gain @ state)
        state = a @ state + b @ controls[-1]
    best = minimize(cost, np.zeros(12), method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(cost(np.ravel(controls)), best.fun, rtol=1e-7)
    np.testing.assert_allclose(np.ravel(controls), best.x, rtol=1e-2, atol=1e-2)


def test_a_humanoid_takes_a_box_that_it_has_not_seen(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["g1", str(G1_PATH), "--demonstrations", "4"])
    runpy.run_path(str(FOLDER / "g1_upper_body.py"), run_name="__main__")
    shown, *boxes = capsys.readouterr().out.splitlines()
    assert "17 joints, grasps to 0.0" in shown
    errors = [float(number) for line in boxes for number in re.findall(r"([\d.]+) mm", line)]
    assert len(errors) == 6
    assert max(errors) < 10


def test_moving_pictures_show_that_time_waits(tmp_path):
    from PIL import Image

    from tests.support.skills import small_bottle

    example = runpy.run_path(str(FOLDER / "moving_pictures.py"))
    moments = list(example["run"](small_bottle(), "shake", "stopped-1@2", 400))
    progress = {round(time, 2): float(command.time) for time, command, _ in moments}
    assert progress[1.8] == pytest.approx(1.8, abs=0.02)
    assert progress[3.8] < 3.5
    example["write"](
        tmp_path / "one.webp", small_bottle(), "shake", "stopped-1@2", "stopped", 100
    )
    with Image.open(tmp_path / "one.webp") as moving:
        assert moving.n_frames == 5
        assert moving.size == (420, 180)
