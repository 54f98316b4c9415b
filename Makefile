# Everything a user does, one line each. Values: make run SCENE=plush PROFILE=smoke DATA=../shared/data ARGS="learn.steps=50"
SCENE ?= carnation
PROFILE ?= default
METHOD ?= physics3d
DATA ?=
ARGS ?=
REAL ?=
PRED ?=
OUT ?=
PORT ?=
LISTEN ?=
PYTHON ?= python3
# these may hold anything, quotes, semicolons and dollar signs too: they are taken as they stand, and reach commands by the
# environment, never as a part of a line that a shell or make reads
$(foreach name,SCENE PROFILE METHOD DATA ARGS PORT LISTEN PYTHON REAL PRED OUT,$(eval override $(name) := $$(value $(name))))
export SCENE PROFILE METHOD DATA ARGS PORT LISTEN PYTHON REAL PRED OUT

SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup run score twin ui view test newest bench lint architecture clean
py := .venv/bin/python
# torch's own threads spin beside those of the renderer and the simulator: OMP_NUM_THREADS=1 unless you say otherwise
threads := OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1}
with_args := $(py) -m pipeline.words
ready := .venv/.ready
# one version of everything, in isolated builds too; sam2 without its optional CUDA extension
quietly := PIP_DISABLE_PIP_VERSION_CHECK=1 SAM2_BUILD_CUDA=0
pip := PIP_CONSTRAINT=constraints.txt $(quietly) $(py) -m pip install --quiet

help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):[^#]*## (.*)/  make \1\t\2/' | expand -t 16
	@echo
	@echo "  SCENE=$$SCENE PROFILE=$$PROFILE METHOD=$$METHOD DATA=$$DATA ARGS=\"$$ARGS\""
	@echo '  scenes: $(basename $(notdir $(wildcard conf/scene/*.yaml)))'

setup: $(ready) ## .venv with everything in it (5 to 10 minutes, 7 GB, once)

$(ready): pyproject.toml constraints.txt
	@"$$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'error: Python >= 3.11 is needed; make setup PYTHON=<path of one>'; exit 1; }
	@test -x $(py) || "$$PYTHON" -m venv .venv || \
		{ echo 'error: no venv; on Debian: apt install python3-venv'; exit 1; }
	@echo 'setting up .venv (5 to 10 minutes, once): build tools, torch, the rest'
	@$(pip) pip setuptools wheel
	@$(pip) torch torchvision
	@$(pip) --no-build-isolation -e '.[dev,sfm,view,export,dask]'
	@touch $@

run: $(ready) ## the pipeline on SCENE; what has been computed before is reused
	@$(threads) $(with_args) -m pipeline scene="$$SCENE" profile="$$PROFILE" method="$$METHOD" $${DATA:+data="$$DATA"}

score: $(ready) ## any two videos compared: REAL=<clip> PRED=<clip> [OUT=<folder>]
	@$(threads) $(py) -m pipeline.score

twin: $(ready) ## a thing with known material as photographs and clips on disk: OUT=<new folder>
	@$(threads) $(py) -m pipeline.twin

ui: $(ready) ## MLflow: prints the address of the page that compares runs, and serves it
	@$(py) -m pipeline.tracking .

view: $(ready) ## a finished run in the browser, and a poke that is simulated live: [PORT=8080] [LISTEN=127.0.0.1]
	@$(threads) $(with_args) -m pipeline.view scene="$$SCENE" profile="$$PROFILE" method="$$METHOD" $${DATA:+data="$$DATA"}

test: $(ready) ## everything that needs no GPU and no weights
	@OMP_NUM_THREADS=1 $(with_args) -m pytest -n 2 --dist loadfile

newest: ## the tests with the newest version of everything, in an environment of its own (.venv-newest)
	@test -x .venv-newest/bin/python || "$$PYTHON" -m venv .venv-newest
	@$(quietly) .venv-newest/bin/python -m pip install --quiet --upgrade pip setuptools wheel
	@$(quietly) .venv-newest/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager torch torchvision
	@$(quietly) .venv-newest/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager --no-build-isolation -e '.[dev,sfm,view,export,dask]'
	@OMP_NUM_THREADS=1 .venv-newest/bin/python -m pipeline.words -m pytest -n 2 --dist loadfile

bench: $(ready) bench-speed bench-renderer bench-filling bench-embedding bench-simulation bench-swaying bench-stability bench-segmentation bench-reconstruction bench-motion bench-real ## measurements with plots, into docs/results; one alone: make bench-<name>

bench-%: export BENCH = $*
bench-%: $(ready)
	@$(threads) $(with_args) "benchmarks/$$BENCH.py"

lint: $(ready) ## style and types
	@$(py) -m ruff check . && $(py) -m ruff format --check . && $(py) -m mypy

architecture: $(ready) ## draw docs/architecture.png and its table from the imports
	@$(py) docs/draw_architecture.py

clean: ## remove results and caches (artifacts, MLflow, Prefect); keeps .venv
	@rm -rf artifacts mlartifacts mlflow.db* .mlflow.lock .prefect .warp .pytest_cache .ruff_cache .mypy_cache .hypothesis build *.egg-info
