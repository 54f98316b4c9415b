# Everything a user does, one line each. Values: make run SCENE=plush PROFILE=smoke DATA=../shared/data learn.steps=50
SCENE ?= carnation
chosen := $(filter-out file,$(origin SCENE))
PROFILE ?= default
METHOD ?= physics3d
DATA ?=
ARGS ?=
REAL ?=
PRED ?=
OUT ?=
FORMAT ?= ply
FRAME ?=
SIZE ?=
LENGTH ?=
MATERIAL ?=
UNSEEN ?=
RESULT ?=
SCENES ?=
METHODS ?=
SEEDS ?=
RUNNER ?=
WORKERS ?=
ADDRESS ?=
PORT ?=
LISTEN ?=
PYTHON ?= python3
# these may hold anything, quotes, semicolons and dollar signs too: they are taken as they stand, and reach commands by the
# environment, never as a part of a line that a shell or make reads
words := SCENE PROFILE METHOD DATA ARGS PYTHON REAL PRED OUT FORMAT FRAME SIZE LENGTH MATERIAL UNSEEN RESULT \
	 SCENES METHODS SEEDS RUNNER WORKERS ADDRESS PORT LISTEN
$(foreach name,$(words),$(eval override $(name) := $$(value $(name))))
# words for the configuration may stand beside them, make run SCENE=plush prior=tiny_video learn.steps=50, as if in ARGS
letters := a% b% c% d% e% f% g% h% i% j% k% l% m% n% o% p% q% r% s% t% u% v% w% x% y% z%
entries := $(foreach name,$(filter $(letters),$(.VARIABLES)),$(if $(filter command,$(firstword $(origin $(name)))),$(name)))
override ARGS := $(ARGS)$(foreach name,$(sort $(entries)), '$(name)=$(subst ','\'',$(value $(name)))')
export $(words)

# files are UTF-8, whatever the locale says
PYTHONUTF8 ?= 1
export PYTHONUTF8

SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup run why sweep compare pin unpin collect score twin reference-motion train-prior fit-curves export still film report ui graph view test newest bench bench-gpu lint \
	handbook scenes configuration architecture clean
py := .venv/bin/python
# torch's own threads spin beside those of the renderer and the simulator: OMP_NUM_THREADS=1 unless you say otherwise
threads := OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1}
with_args := $(py) -m pipeline.words
ready := .venv/.ready
extras := pipeline,priors,sam,sfm,view,export,dask,dev
# one version of everything, in isolated builds too; sam2 without its optional CUDA extension
quietly := PIP_DISABLE_PIP_VERSION_CHECK=1 SAM2_BUILD_CUDA=0
pip := PIP_CONSTRAINT=constraints.txt $(quietly) $(py) -m pip install --quiet

# what names a run, for commands that show what it left
of_run := scene="$$SCENE" profile="$$PROFILE" method="$$METHOD" $${DATA:+data="$$DATA"}

help: ## this list
	@grep -hE '^[a-z -]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+)[a-z -]*:[^#]*## (.*)/  make \1\t\2/' | expand -t 16
	@echo
	@echo "  SCENE=$$SCENE PROFILE=$$PROFILE METHOD=$$METHOD DATA=$$DATA ARGS=\"$$ARGS\""
	@echo '  scenes: $(basename $(notdir $(wildcard conf/scene/*.yaml)))'

setup: $(ready) ## .venv with everything in it (5 to 10 minutes, 8.5 GB on disk, once)

$(ready): pyproject.toml setup.py constraints.txt
	@"$$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'error: Python >= 3.11 is needed; make setup PYTHON=<path of one>'; exit 1; }
	@test -x $(py) || "$$PYTHON" -m venv .venv || \
		{ echo 'error: no venv; on Debian: apt install python3-venv'; exit 1; }
	@echo 'setting up .venv (5 to 10 minutes, once): build tools, torch, the rest'
	@$(pip) pip setuptools wheel
	@$(pip) torch torchvision
	@$(pip) --no-build-isolation -e '.[$(extras)]'
	@touch $@

run: $(ready) ## the pipeline on SCENE; what has been computed before is reused
	@$(threads) $(with_args) -m pipeline $(of_run)

why: $(ready) ## which stages `make run` would compute, and what has changed; runs nothing
	@$(with_args) -m pipeline.why $(of_run)

sweep: $(ready) ## many runs at once: SCENES=carnation,ball METHODS=... SEEDS=0,1 RUNNER=thread|process|dask|ray WORKERS=2 [ADDRESS=tcp://...]
	@$(threads) $(with_args) -m pipeline.sweep scenes="$$SCENES" methods="$$METHODS" seeds="$$SEEDS" runner="$$RUNNER" workers="$$WORKERS" \
		address="$$ADDRESS" profile="$$PROFILE" $${DATA:+data="$$DATA"}

compare: $(ready) ## every method on SCENES=carnation,cake, the paper's table: [PROFILE=smoke] [METHODS=...] [OUT=<folder>]
	@$(threads) $(with_args) -m pipeline.compare scenes="$${SCENES:-$$SCENE}" methods="$$METHODS" $${RUNNER:+runner="$$RUNNER"} \
		$${WORKERS:+workers="$$WORKERS"} $${OUT:+out="$$OUT"} profile="$$PROFILE" $${DATA:+data="$$DATA"}

pin unpin: $(ready) ## keep a result whatever is cleaned or collected: make pin RESULT=learn/<fingerprint>
	@$(py) -m pipeline.shelf $@ "$$RESULT"

collect: $(ready) ## remove the results that no run in MLflow refers to (delete runs on its page first)
	@$(py) -m pipeline.shelf collect .

score: $(ready) ## any two videos compared: REAL=<clip> PRED=<clip> [OUT=<folder>]
	@$(threads) $(py) -m pipeline.score

twin: $(ready) ## a thing with known material as photographs and clips on disk: OUT=<new folder> [ARGS="seed=1 youngs_modulus=3e5"]
	@$(threads) $(with_args) -m pipeline.twin

reference-motion: $(ready) ## how a twin moves by finite elements, kept for its scene; pip install pytetwild pyvista
	@$(threads) $(with_args) -m pipeline.reference_motion $(of_run)

train-prior: $(ready) ## a small video model from films it makes; goes on where it was: [OUT=outputs/tiny_video] [ARGS="steps=... seed=0 device=cpu"]
	@$(threads) $(with_args) -m pipeline.train_prior

export: $(ready) ## the moving Gaussians for other programs: FORMAT=ply|usd|gltf|spz [OUT=<new folder>] [FRAME=<of gltf, spz>]
	@$(threads) $(with_args) -m pipeline.export $(of_run)

still: $(ready) ## the picture to hand to an image-to-video model: [OUT=<new .png>] [SIZE=1024x576]; then capture.clip=<its clip>
	@$(threads) $(with_args) -m pipeline.still $(of_run)

film: $(ready) ## the motion from a camera that goes round it: [OUT=<new .mp4>] [SIZE=1280x720] [LENGTH=<seconds>]
	@$(threads) $(with_args) -m pipeline.film $(of_run)

report: $(ready) ## one HTML page of what SCENE=... left, or, without SCENE, of all runs: [OUT=<new .html>]
	@$(threads) $(with_args) -m pipeline.web $(if $(chosen),$(of_run))
fit-curves: $(ready) ## a material from tables of a test machine: DATA=<folder of csv> MATERIAL=<name> [UNSEEN=<test>] [OUT=<folder>]
	@$(threads) $(py) -m pipeline.fit_curves

ui: $(ready) ## MLflow: prints the address of the page that compares runs, and serves it
	@$(py) -m pipeline.tracking .

graph: $(ready) ## Prefect's picture of the last run: prints its address, and serves it
	@$(py) -m pipeline.graph .

view: $(ready) ## a finished run in the browser, and a poke that is simulated live: [PORT=8080] [LISTEN=127.0.0.1]
	@$(threads) $(with_args) -m pipeline.view $(of_run)

test: $(ready) ## everything that needs no GPU and no weights
	@OMP_NUM_THREADS=1 $(with_args) -m pytest -n 2 --dist loadfile

newest: ## the tests with the newest version of everything, in an environment of its own (.venv-newest)
	@test -x .venv-newest/bin/python || "$$PYTHON" -m venv .venv-newest
	@$(quietly) .venv-newest/bin/python -m pip install --quiet --upgrade pip setuptools wheel
	@$(quietly) .venv-newest/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager torch torchvision
	@$(quietly) .venv-newest/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager --no-build-isolation -e '.[$(extras)]'
	@OMP_NUM_THREADS=1 .venv-newest/bin/python -m pipeline.words -m pytest -n 2 --dist loadfile

bench: $(ready) bench-speed bench-renderer bench-filling bench-embedding bench-simulation bench-swaying bench-stability bench-segmentation bench-reconstruction bench-motion bench-real bench-learning bench-robustness ## measurements with plots, into docs/results; one alone: make bench-<name>

# no `make setup`: a Python with torch, Warp, numpy, scipy, matplotlib, jaxtyping and annotated-types is enough
bench-gpu: ## simulator and renderer on a GPU, right and how fast, under 8 minutes: [DATA=<folder with lego>] [ARGS="device=cuda seed=0"]
	@$(threads) "$$(test -x $(py) && echo $(py) || echo "$$PYTHON")" benchmarks/gpu.py $${ARGS//\'/} $${DATA:+data="$$DATA"}

bench-%: export BENCH = $*
bench-%: $(ready)
	@$(threads) $(with_args) "benchmarks/$$BENCH.py"

lint: $(ready) ## style and types
	@$(py) -m ruff check . && $(py) -m ruff format --check . && $(py) -m mypy

handbook: $(ready) ## write docs/handbook.md from conf/handbook.yaml
	@PYTHONPATH=. $(py) docs/write_handbook.py

configuration: $(ready) ## write docs/configuration.md from conf/ and the hints of the classes that it names
	@PYTHONPATH=. $(py) docs/write_configuration.py

scenes: $(ready) ## draw docs/scenes/*.jpg, a picture of each scene that is composed of shapes
	@PYTHONPATH=. $(threads) $(py) docs/draw_scenes.py

architecture: $(ready) ## draw docs/architecture.png and its table from the imports
	@$(py) docs/draw_architecture.py

clean: ## remove results and caches (artifacts, MLflow, Prefect), showing their sizes; keeps .venv and pinned results
	@"$$(test -x $(py) && echo $(py) || echo "$$PYTHON")" -m pipeline.shelf clean artifacts sweeps comparisons mlartifacts mlflow.db* .mlflow.lock .prefect \
		.warp .pytest_cache .ruff_cache .mypy_cache .hypothesis build *.egg-info
