# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal

.PHONY: demo paper test nightly check docs joss fuzz lint types wheel-check bench redundancy figures charts clean

demo: $(INSTALLED)  ## fit the 7-DoF arm, print its quality, save chart and picture in out/
	$(BIN)/orthocas demo --out out

paper: $(INSTALLED)  ## the 30 figures of the paper in out/paper/; FIGURE=fig06 draws one
	$(BIN)/python -m examples.paper $(or $(FIGURE),all) --out out/paper

test: $(INSTALLED)  ## the test suite
	$(PYTEST)

nightly: $(INSTALLED)  ## the tests that `make test` leaves out
	$(PYTEST) -m nightly

check: lint  ## while working: lint and the fast tests, with the slowest of them named
	$(PYTEST) -m "not slow and not nightly" --durations 5

docs: $(INSTALLED)  ## the documentation site in build/docs, its pages run; a warning is an error
	$(BIN)/python -m pip install --quiet -e '.[docs]'
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -q -W --keep-going -E -j 2 -b html docs build/docs

joss: $(INSTALLED)  ## the paper in docs/joss as build/joss/paper.pdf, to read
	$(BIN)/python -m pip install --quiet -e '.[joss]'
	$(BIN)/python tools/joss.py

COUNT ?= 1000
fuzz: $(INSTALLED)  ## the campaign of faults; COUNT mutants of each kind, CAMPAIGN="charts ..." for some kinds
	cd tests && PYTHONPATH=../examples:shared ../$(BIN)/python -m fuzz $(COUNT) $(CAMPAIGN)

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED) build/site  ## mypy on what is installed: the wheel, unpacked
	cd build/site && ../../$(BIN)/mypy --config-file ../../pyproject.toml -p orthocas

wheel-check: $(INSTALLED)  ## the built wheel in a fresh environment, outside the repo
	$(BIN)/python tests/check_wheel.py

bench: $(INSTALLED)
	$(BIN)/python -m pip install --quiet -e '.[bench]'
	$(BIN)/python benchmarks/run_all.py

redundancy: .venv-redundancy/.installed  ## methods of redundancy resolution side by side (30 minutes), for docs/measurements/redundancy.md
	OMP_NUM_THREADS=1 PYTHONPATH=. .venv-redundancy/bin/python benchmarks/redundancy_benchmark.py
	PYTHONPATH=. .venv-redundancy/bin/python benchmarks/redundancy_page.py

.venv-redundancy/.installed: benchmarks/redundancy/requirements.txt
	$(PYTHON) -m venv .venv-redundancy
	.venv-redundancy/bin/python -m pip install --quiet -r $<
	touch $@

figures: $(INSTALLED)  ## measure the cheap figures of the documentation again, and show what moved beyond its tolerance
	OMP_NUM_THREADS=1 $(BIN)/python tools/figures.py $(ONLY)

charts: $(INSTALLED)  ## the ready charts, those that are missing or changed; ONLY=panda-position makes one again
	$(BIN)/python examples/ready_charts.py $(ONLY)

$(INSTALLED): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -e '.[test,view]'
	touch $@

build/site: $(INSTALLED) $(shell find orthocas problems solvers -type f -not -path '*/__pycache__/*')
	rm -rf build
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build/wheel .
	$(BIN)/python -m pip install --quiet --no-deps --upgrade --target build/site build/wheel/*.whl

clean:
	rm -rf $(VENV) .venv-redundancy build dist out *.egg-info
