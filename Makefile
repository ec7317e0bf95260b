# Everything installs into .venv; `make` alone lists the targets.

# Tried in this order; the first that runs and is of a version that lerobot and its
# dependencies support is taken. Another one: make test PYTHON=/path/to/python
PYTHON ?= python3.12 python3.13 python3 python
SUPPORTED := import sys; sys.exit(not (3, 12) <= sys.version_info[:2] < (3, 14))
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check --constraint constraints.txt

PROJECTS := $(addsuffix pyproject.toml,./ policies/ environments/ evaluation/)
PACKAGES_bench := .[bench]
PACKAGES_cli := .[cli]
PACKAGES_compare := .[cli] ./policies ./environments ./evaluation[compare]
PACKAGES_evidence := .[cli] ./policies ./environments[g1] ./evaluation[compare]
PACKAGES_metaworld := . ./policies ./environments ./evaluation[metaworld]
PACKAGES_mutation := .[mutation]
PACKAGES_test := .[test] ./policies[test] ./environments[test] ./evaluation[test]

COMPARE := HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(BIN)/tpgmm compare
# Processes of one thread each that `make evidence` runs at a time.
WORKERS ?= 2
# Meta-World asks for another MuJoCo than the rest, and dm-control follows MuJoCo
METAWORLD := .venv-metaworld
BENCH := OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks
MEASURE := HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(BIN)/python -m tpgmm_evaluation.regressions
MEASURED := --workers $(WORKERS) $(if $(SMALL),--small) $(if $(ONLY),--only $(ONLY))

.PHONY: help demo compare evidence conditions metaworld bench baseline regressions test quality oldest newest fuzz mutants lint types docs docs-fast check dist constraints clean
.NOTPARALLEL:

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' Makefile

demo: $(VENV)/.installed-cli ## Run the paper's experiment; results in out/demo
	OMP_NUM_THREADS=1 $(BIN)/tpgmm demo --out out/demo

compare: $(VENV)/.installed-compare ## Look at all tasks for half an hour: TP-GMM and quick baselines; out/compare
	$(COMPARE) --env suite --demonstrations 3,10 --policies quick --episodes 10 --workers 2 --out out/compare

evidence: $(VENV)/.installed-evidence ## Measure everything, for days: WORKERS=8; out/evidence
	$(COMPARE) --env all --demonstrations 3,10 --seeds 0,1,2 --policies all --episodes 100 --budget 30 \
	    --workers $(WORKERS) --out out/evidence
	$(COMPARE) --env all --demonstrations 10 --seeds 0,1,2 --policies tpgmm --conditions all --episodes 100 \
	    --budget 30 --workers $(WORKERS) --out out/evidence

conditions: $(VENV)/.installed-compare ## Try TP-GMM where things go wrong, beside an open loop; out/conditions
	$(COMPARE) --demonstrations 10 --policies tpgmm --conditions all --out out/conditions

bench: $(VENV)/.installed-bench ## Measure speed beside other libraries; BENCH_ARGS="--only step"; out/bench
	$(BENCH) --out out/bench $(BENCH_ARGS)

baseline: $(VENV)/.installed-evidence ## Measure what must not get worse, for hours; SMALL=1: minutes; ONLY=goldens,demo; out/baseline
	$(MEASURE) baseline $(MEASURED)

regressions: $(VENV)/.installed-evidence ## Measure again and compare; SMALL=1 ONLY=times; BASE=../checkout takes times in turns
	$(MEASURE) compare --again $(MEASURED) $(if $(BASE),--base $(BASE))

metaworld: ## Try all tasks of Meta-World; ARGS="--tasks reach-v3 --demonstrations 1,3"; out/metaworld
	$(MAKE) $(METAWORLD)/.installed-metaworld VENV=$(METAWORLD)
	HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(METAWORLD)/bin/python -m tpgmm_evaluation.metaworld $(ARGS)

test: $(VENV)/.installed-test ## Run the tests but slow ones; all, as CI: PYTEST_ARGS="-m ''"
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -m "not slow" $(PYTEST_ARGS)

# Without mink, and without lerobot, whose oldest version `make test` takes (constraints.txt) and whose newest
# `make newest`; and the oldest pyarrow cannot write one of the damaged files.
oldest: ## Run the tests of the core with the oldest versions promised, in .venv-oldest
	$(firstword $(wildcard $(BIN)/python) python3) -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --disable-pip-version-check \
	    --constraint constraints-oldest.txt '.[cli,collada,hub,simulation]' \
	    'pytest>=8.2' 'pytest-timeout>=2.3' 'hypothesis>=6.100' 'gmr>=2.0' 'packaging>=24.2' 'pytorch-kinematics>=0.10' \
	    'example-robot-data>=4.1' pin==2.7.0
	OMP_NUM_THREADS=1 .venv-oldest/bin/python -m pytest tests/tpgmm_torch tests/tpgmm_control tests/tpgmm_datasets tests/tpgmm_tools \
	    --continue-on-collection-errors -o filterwarnings=default \
	    --ignore tests/tpgmm_tools/app \
	    --ignore tests/tpgmm_datasets/lerobot/test_calibration.py \
	    --deselect tests/tpgmm_datasets/test_writer.py::test_lerobot_opens_what_is_written_and_the_other_way_round \
	    --deselect 'tests/tpgmm_datasets/lerobot/test_episodes.py::test_rows_that_are_wrong_are_refused_and_located[nan-nulls-place3]' \
	    $(PYTEST_ARGS)

newest: ## Run the tests with the newest versions that are allowed, in .venv-newest
	$(firstword $(wildcard $(BIN)/python) python3) -m venv .venv-newest
	.venv-newest/bin/python -m pip install --disable-pip-version-check --upgrade \
	    --upgrade-strategy eager $(foreach package,$(PACKAGES_test),'$(package)')
	OMP_NUM_THREADS=1 .venv-newest/bin/python -m pytest -n 2 -o filterwarnings=default $(PYTEST_ARGS)

fuzz: $(VENV)/.installed-test ## Damage thousands of files, kill hundreds of saves, lie to controllers: half an hour
	TPGMM_FUZZ=full HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest --timeout 0 \
	    tests/project/test_damaged_files.py tests/project/test_killed_saves.py \
	    tests/tpgmm_control/loop/test_controller.py $(PYTEST_ARGS)

mutants: $(VENV)/.installed-mutation ## Count changed lines that a room's tests notice: ROOM=tpgmm_torch/operators
	HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(BIN)/python tests/mutants.py $(ROOM) $(MUTANTS_ARGS)

quality: lint types ## Check what every commit must keep, in two minutes: style, types, layers, budgets, docstrings
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 tests/project/test_layers.py tests/project/test_budgets.py \
	    tests/project/test_docs_docstrings.py tests/project/test_docs_reference.py tests/project/test_community_files.py

lint: $(VENV)/.installed-test ## Check style and formatting
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(VENV)/.installed-test ## Check the type hints
	$(BIN)/python -m mypy

docs: $(VENV)/.installed-test ## Build the documentation; open docs/_build/html/index.html
	HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

docs-fast: $(VENV)/.installed-test ## Build the pages alone, without gallery and source; docs/_build/fast
	HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -b html -t fast docs docs/_build/fast

check: lint types test docs ## All four

dist: $(VENV)/.installed-test ## Build all distributions, sdist and wheel, into dist
	for project in . policies environments evaluation; do \
	    $(BIN)/python -m build --no-isolation --outdir dist $$project || exit; \
	done

constraints: $(VENV)/.installed-test ## Write the versions in .venv into constraints.txt
	{ grep '^#' constraints.txt; $(BIN)/python -m pip freeze --all --exclude-editable \
	    --exclude pip --exclude editables; } > constraints.new
	mv constraints.new constraints.txt

clean: ## Remove results and caches; the environment stays
	rm -rf docs/_build docs/_pictures docs/gallery out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

# A stamp is older than the files below when they ask for other packages than are installed.
$(VENV)/.installed-%: $(PROJECTS) constraints.txt | $(BIN)/pip
	$(INSTALL) $(foreach package,$(PACKAGES_$*),--editable '$(package)')
	@touch $@

$(METAWORLD)/constraints.txt: constraints.txt | $(METAWORLD)/bin/pip
	grep -v -i -E '^(mujoco|dm-control|metaworld)==' constraints.txt > $@

$(METAWORLD)/.installed-metaworld: $(PROJECTS) $(METAWORLD)/constraints.txt
	$(METAWORLD)/bin/python -m pip install --disable-pip-version-check \
	    --constraint $(METAWORLD)/constraints.txt $(foreach package,$(PACKAGES_metaworld),--editable '$(package)')
	@touch $@

# pip is what venv writes last, so it stands for an environment that is complete. A pyenv
# shim may exist and yet not run: only the answer of an interpreter counts.
$(BIN)/pip:
	@for python in $(PYTHON); do \
	    "$$python" -c '$(SUPPORTED)' 2>/dev/null || continue; \
	    "$$python" -c 'import ensurepip, venv' 2>/dev/null || { \
	        echo "error: $$python has no ensurepip: install your system's package python3-venv, or give another one: make PYTHON=..." >&2; exit 1; }; \
	    echo "creating $(VENV) with $$("$$python" -V) ($$python)"; \
	    exec "$$python" -m venv $(VENV); \
	done; \
	echo "error: Python 3.12 or 3.13 is needed, and none of these is one: $(PYTHON); give one: make PYTHON=..." >&2; exit 1
