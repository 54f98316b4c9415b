# Everything a user does, one line each. Values: make run SCENE=plush PROFILE=smoke DATA=../shared/data ARGS="learn.steps=50"
SCENE ?= carnation
PROFILE ?= default
METHOD ?= physics3d
DATA ?=
ARGS ?=
PORT ?= 5000
PYTHON ?= python3
export REAL PRED OUT # they travel to the recipes in the environment, as they are

SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup run score twin ui view test bench lint clean
py := .venv/bin/python
# torch's own threads spin beside those of the renderer and the simulator: OMP_NUM_THREADS=1 unless you say otherwise
ready := .venv/.ready
# one version of everything, in isolated builds too; sam2 without its optional CUDA extension
pip := PIP_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 SAM2_BUILD_CUDA=0 $(py) -m pip install --quiet

help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):[^#]*## (.*)/  make \1\t\2/' | expand -t 16
	@echo
	@echo '  SCENE=$(SCENE) PROFILE=$(PROFILE) METHOD=$(METHOD) DATA=$(DATA) ARGS="$(ARGS)"'
	@echo '  scenes: $(basename $(notdir $(wildcard conf/scene/*.yaml)))'

setup: $(ready) ## .venv with everything in it (5 to 10 minutes, 7 GB, once)

$(ready): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'error: Python >= 3.11 is needed; make setup PYTHON=<path of one>'; exit 1; }
	@test -x $(py) || $(PYTHON) -m venv .venv || \
		{ echo 'error: no venv; on Debian: apt install python3-venv'; exit 1; }
	@echo 'setting up .venv (5 to 10 minutes, once): build tools, torch, the rest'
	@$(pip) pip setuptools wheel
	@$(pip) torch torchvision
	@$(pip) --no-build-isolation -e '.[dev,sfm]'
	@touch $@

run: $(ready) ## the pipeline on SCENE; what has been computed before is reused
	@OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(py) -m pipeline scene=$(SCENE) profile=$(PROFILE) method=$(METHOD) $(if $(DATA),data=$(DATA)) $(ARGS)

score: $(ready) ## any two videos compared: REAL=<clip> PRED=<clip> [OUT=<folder>]
	@OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(py) -m pipeline.score

twin: $(ready) ## a thing with known material as photographs and clips on disk: OUT=<new folder>
	@OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(py) -m pipeline.twin

ui: $(ready) ## MLflow: prints the address of the page that compares runs, and serves it
	@PORT=$(PORT) $(py) -m pipeline.tracking .

view: ## the video and previews of the last run
	@folder=$$(cat artifacts/.latest 2>/dev/null); \
	test -d "$$folder" || { echo 'error: nothing rendered yet; make run SCENE=$(SCENE)'; exit 1; }; \
	ls -d "$$folder"/*.mp4 "$$folder"/previews/*; \
	if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ] && command -v xdg-open >/dev/null; then xdg-open "$$(ls "$$folder"/*.mp4 | head -1)"; fi

test: $(ready) ## everything that needs no GPU and no weights
	@OMP_NUM_THREADS=1 $(py) -m pytest -n 2 --dist loadfile $(ARGS)

bench: $(ready) bench-speed bench-renderer bench-filling bench-embedding bench-simulation bench-stability bench-segmentation bench-reconstruction bench-motion ## measurements with plots, into docs/results; one alone: make bench-<name>

bench-%: $(ready)
	@OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(py) benchmarks/$*.py $(ARGS)

lint: $(ready) ## style and types
	@$(py) -m ruff check . && $(py) -m ruff format --check . && $(py) -m mypy

clean: ## remove results and caches (artifacts, MLflow, Prefect); keeps .venv
	@rm -rf artifacts mlartifacts mlflow.db .prefect .pytest_cache .ruff_cache .mypy_cache .hypothesis build *.egg-info
