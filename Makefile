# lunargr: `make demo` shows it working, `make test` proves it, `make help` lists the rest.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LUNARGR := $(BIN)/lunargr
STAMP := $(VENV)/.installed
TESTED := $(VENV)/.installed-tests
SHARED := $(or $(LUNARGR_SHARED),$(abspath ../shared))

# A module is compiled once, when it is first imported: pip leaves it to us (see below).
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help install demo demo-full demo-paper demo-albedo figures test test-slow mutants fuzz endurance lint bench campaign campaign-laboratory campaign-real docs wheel vendor-js reproduce-apollo15 reproduce-models clean

help: ## list the targets
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-20s %s\n", $$1, $$2}'

install: $(STAMP) ## create .venv with the lunargr command

# --no-compile: of ten thousand modules a tenth is ever used, and compiling all took half of the time. Those are imported here.
PIP := $(BIN)/python -m pip install --quiet --no-compile

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "lunargr needs Python >= 3.11; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	@# torch first and pinned: the CPU build, where the registry has one, instead of gigabytes of CUDA packages
	$(PIP) $$(grep '^torch==' constraints.txt)
	$(PIP) --constraint constraints.txt --editable .
	$(BIN)/python -c 'import pkgutil, stages; [__import__(m.name) for m in pkgutil.walk_packages(stages.__path__, "stages.")]'
	@touch $@

$(TESTED): $(STAMP)
	$(PIP) --constraint constraints.txt --editable '.[test,lint,spice]'
	@touch $@

# How sources and pages are written: lint looks at it, test does not.
STYLE := tests/test_docstrings.py tests/test_figures.py tests/test_layers.py tests/test_package.py

test: $(TESTED) ## the tests that every change must pass (about nine minutes on two cores)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow" $(STYLE:%=--ignore=%)

test-slow: $(TESTED) ## the longer checks
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m slow

mutants: $(TESTED) ## plant bugs one at a time and see whether the tests notice, before a release; ONLY=word for some
	OMP_NUM_THREADS=1 $(BIN)/python tests/validation/mutants.py --only "$(ONLY)"

fuzz: $(TESTED) ## three thousand malformed inputs through the real commands: one line each, no traceback, nothing left
	OMP_NUM_THREADS=1 $(BIN)/python tests/validation/malformed.py

endurance: $(TESTED) ## interrupt every stage TIMES times (20) at random moments, run it again, compare every byte
	$(BIN)/python tests/validation/endurance.py --times $(or $(TIMES),20)

lint: $(TESTED) ## ruff, formatting, mypy, and how sources and pages are written
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q $(STYLE)

bench: $(TESTED) ## speed and memory, each beside a named peer in the same run; on a quiet machine, then make figures; ONLY=word for some
	mkdir -p results/bench
	for script in tests/validation/benchmarks/bench_*$(ONLY)*.py; do echo "== $$script"; \
	  $(BIN)/python $$script | tee results/bench/$$(basename $$script .py).txt; done

campaign: $(TESTED) ## what diagnose names on fresh hidden scenes (hours); SEED=N is drawn once, after the code is frozen
	$(BIN)/python tests/validation/campaign.py --seed $(or $(SEED),$(error make campaign SEED=N)) --scenes 10 --nulls 40 --jobs $(or $(JOBS),2) --output results/campaign

LABORATORY = laboratory
campaign-laboratory: $(TESTED) ## what diagnose names in files of another laboratory's simulator; SEED=N, LABORATORY=second_laboratory for another one
	$(BIN)/python tests/validation/laboratory_campaign.py --laboratory $(LABORATORY) --seed $(or $(SEED),$(error make campaign-laboratory SEED=N)) --cases 44 --jobs $(or $(JOBS),2) --output results/$(LABORATORY)

# Pairs of real photographs; REGISTERED=pairs.h5 adds a registered set.
campaign-real: $(TESTED) results/apollo15/diagnosis.h5 ## plant effects into real photographs and see what diagnose names (needs the reference data)
	OMP_NUM_THREADS=1 $(BIN)/python tests/validation/planted.py --raw $(A)/stack.h5 $(if $(REGISTERED),--registered $(REGISTERED)) --seed $(or $(SEED),5) --resamples $(or $(RESAMPLES),40) --jobs $(or $(JOBS),2) --output results/planted

docs: $(TESTED) ## write the generated parts of docs/ again, and build the site in build/site
	$(BIN)/python examples/cli_page.py
	$(BIN)/python examples/photometry_page.py --oracles $(SHARED)/oracles
	$(PIP) --constraint constraints.txt --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "Open $(abspath build/site/index.html)"

wheel: $(STAMP) ## build/dist/*.whl; URL=https://... of the repository puts its pictures and links on the package's page
	LUNARGR_URL=$(URL) $(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build/dist .

VENDOR := stages/view/assets/vendor

vendor-js: ## bundle three.js for the page of `lunargr view` again (needs npm; versions in its package.json)
	npm install --silent --no-package-lock --prefix $(VENDOR)
	npm run --silent --prefix $(VENDOR) bundle
	cp $(VENDOR)/node_modules/three/LICENSE $(VENDOR)/LICENSE.three.txt
	rm -rf $(VENDOR)/node_modules

# --- the embedded scene --------------------------------------------------------------------------------------------

# Two chains with the same rules: they differ in D, the folder, and in what is set for it here.
D := demo-full
SIZE_demo := --size-px 1024 --images 12
COUNT_demo := 400
EPOCHS_demo := 4
RUNS_demo := 0
PLACES_demo := 12
NOTE_demo := --note "One training run, fewer crops, a smaller scene. The figures of README come from 'make demo-full'."
COUNT_demo-full := 1200
EPOCHS_demo-full := 6
RUNS_demo-full := 0 1 2
PLACES_demo-full := 20
ALSO_demo-full = $(D)/held_out.h5 $(D)/match.json
FIGURES_demo-full = $(D)/figures/match_daisy_1.png $(D)/figures/match_sift_1.png

# One split of the scene for everything that is sampled from it: a quarter of its ground tiles is for testing (20 of demo-full).
DEMO_SPLIT := --split 65/10/25
# fp32: the README's figures must not hang on whether a processor is made for bf16
# batches of 8: few pairs need many steps
DEMO_TRAIN = --epochs $(EPOCHS_$(D)) --batch 8 --precision fp32
DEMO_RUNS = $(foreach seed,$(RUNS_$(D)),$(D)/checkpoint_$(seed).h5)

CORES := $(shell nproc 2>/dev/null || getconf _NPROCESSORS_ONLN)
# Of four steps beside each other; small crops gain little from a second thread.
THREADS := $(shell echo $$(($(CORES) < 8 ? 1 : $(CORES) / 4)))

demo demo-full: $(STAMP)
	+$(MAKE) --no-print-directory D=$@ $@/scene.h5
	+OMP_NUM_THREADS=$(THREADS) $(MAKE) --no-print-directory -j $(CORES) BESIDE=1 D=$@ $@/report.html
	@echo; echo "Open $(abspath $@/report.html)"; echo "and  $(abspath $@/view.html)"

demo: ## the stages in five minutes on a small embedded scene: a report and a map to relight
demo-full: ## the whole embedded scene, three training runs: the figures of README (a quarter of an hour)

# Of steps beside each other every line says whose it is, and bars, which draw over each other, become lines.
SAYS = $(if $(BESIDE),2> >(trap "" INT; sed -u "s/^/$(basename $(@F)): /" >&2))

$(D)/scene/images.csv: | $(STAMP)
	$(LUNARGR) simulate -o $(D)/scene $(SIZE_$(D)) --hidden sun_azimuth:error_deg=5 --overwrite

$(D)/scene.h5: $(D)/scene/images.csv
	$(LUNARGR) ingest $(D)/scene/dem.tif --images $(D)/scene/images.csv --gsd 5 -o $@ --overwrite

$(D)/crops.h5: $(D)/scene.h5
	$(LUNARGR) sample $< --count $(COUNT_$(D)) $(DEMO_SPLIT) -o $@ --overwrite $(SAYS)

$(D)/pairs.h5: $(D)/crops.h5
	$(LUNARGR) project $< -o $@ --overwrite $(SAYS)

# Training is random: from several seeds a gain can be told from luck.
$(DEMO_RUNS): $(D)/checkpoint_%.h5: $(D)/pairs.h5
	$(LUNARGR) train $< $(DEMO_TRAIN) --seed $* -o $@ --overwrite --resume $(SAYS)

$(D)/svbrdf.h5: $(D)/scene.h5 $(D)/checkpoint_0.h5
	$(LUNARGR) infer $^ -o $@ --overwrite $(SAYS)

# what the photographs show beyond terrain: all of them, for pictures ...
$(D)/svbrdf_albedo.h5: $(D)/svbrdf.h5 $(D)/scene.h5
	$(LUNARGR) albedo $^ -o $@ --overwrite $(SAYS)

# ... and without every fourth, to be judged by these
$(D)/fold_%.h5: $(D)/svbrdf.h5 $(D)/scene.h5
	$(LUNARGR) albedo $^ --fold $*/4 --no-geotiff -o $@ --overwrite $(SAYS)

$(D)/render.exr: $(D)/svbrdf_albedo.h5
	$(LUNARGR) render $< --sun-azimuth 270 --sun-elevation 15 -o $@ --overwrite $(SAYS)

$(D)/view.html: $(D)/svbrdf_albedo.h5 $(D)/pairs.h5
	$(LUNARGR) view $< --pairs $(D)/pairs.h5 -o $@ --title "lunargr demo: the embedded scene" --overwrite $(SAYS)

$(D)/evaluation.h5: $(D)/pairs.h5 $(DEMO_RUNS)
	$(LUNARGR) evaluate $^ -o $@ $(if $(FIGURES_$(D)),--figures $(D)/figures) --overwrite $(SAYS)

$(D)/held_out.h5: $(D)/pairs.h5 $(D)/fold_1.h5
	$(LUNARGR) held-out $^ -o $@ --overwrite $(SAYS)

$(D)/match.json: $(D)/pairs.h5 $(D)/checkpoint_0.h5
	$(LUNARGR) match $^ --count 8 --json $@ --figures $(D)/figures --overwrite $(SAYS)

# Places that every image covers: what the images disagree on there cannot be the ground.
$(D)/stack.h5: $(D)/scene.h5
	$(LUNARGR) sample $< --stack --crop 64 --count $(PLACES_$(D)) $(DEMO_SPLIT) -o $(D)/stack_crops.h5 --overwrite $(SAYS)
	$(LUNARGR) project $(D)/stack_crops.h5 -o $@ --overwrite $(SAYS)

$(D)/diagnosis.h5: $(D)/stack.h5
	$(LUNARGR) diagnose $< --model hapke -o $@ --json $(D)/diagnosis.json --report $(D)/diagnosis.html --overwrite $(SAYS)

# The long ones first: no core is left alone with one of them. Then what a person can look at while the rest runs.
$(D)/report.html: $(DEMO_RUNS) $(D)/diagnosis.h5 $(D)/view.html $(D)/render.exr $(D)/evaluation.h5 $(ALSO_$(D))
	$(LUNARGR) report $(D)/scene.h5 $(D)/crops.h5 $(D)/pairs.h5 $(D)/checkpoint_0.h5 $(D)/svbrdf_albedo.h5 $(D)/evaluation.h5 \
	    $(ALSO_$(D)) $(D)/diagnosis.json $(D)/render.png $(FIGURES_$(D)) $(D)/view.html -o $@ $(NOTE_$(D)) \
	    --title "lunargr demo: the embedded scene" --overwrite $(SAYS)

demo-paper: $(D)/m2.h5 ## the model M2 of the Lunar-G2R paper on the pairs of demo-full, one run with the paper's network

$(D)/checkpoint_m2.h5: $(D)/pairs.h5
	$(LUNARGR) train $< --model M2 --positive --widths 16-32-64-128-256 --dropout 0.1-0.1-0.2-0.2-0.3 --brightness 1 \
	    $(DEMO_TRAIN) -o $@ --overwrite --resume

$(D)/m2.h5: $(D)/pairs.h5 $(D)/checkpoint_m2.h5
	$(LUNARGR) evaluate $^ --only learned --only learned_gain_offset -o $@ --overwrite

demo-albedo: $(D)/match_albedo.json ## judge the albedo of demo-full by all of its images, each left out once, and by matching features

$(D)/held_out_all.h5: $(D)/pairs.h5 $(foreach fold,1 2 3 4,$(D)/fold_$(fold).h5)
	$(LUNARGR) held-out $^ -o $@ --overwrite

$(D)/match_albedo.json: $(D)/held_out_all.h5
	$(LUNARGR) match $< --count 20 --json $@ --overwrite

figures: $(TESTED) ## write every figure of README.md and docs/, and the notebook, from what demo-full, reproduce-* and bench left
	$(BIN)/python examples/figures.py
	@# the notebook trains its own network for two passes, and keeps it
	if [ -f $(D)/pairs.h5 ]; then cd $(D) && ../$(BIN)/python ../examples/notebook_page.py; fi

# --- real photographs: Apollo 15 metric camera frames over the GLD100 elevation model ------------------------------

A := results/apollo15
A_DATA := $(SHARED)/data/apollo15
A_RUNS := $(foreach seed,0 1 2,$(A)/checkpoint_$(seed).h5)
A_FOLDS := $(foreach fold,1 2 3 4 5,$(A)/fold_$(fold).h5)

# Frames with their cameras: 125 m a pixel, orthorectified; what is left of their poses is registered.
C := results/apollo15_cubes
C_RUNS := $(foreach seed,0 1 2,$(C)/checkpoint_$(seed).h5)
C_FOLDS := $(foreach fold,1 2 3,$(C)/fold_$(fold).h5)

# The film frames need the reference folder; the cubes are fetched where it is not there.
reproduce-apollo15: $(C)/report.html $(if $(wildcard $(A_DATA)/images.csv),$(A)/report.html) ## the same stages on real Apollo 15 frames: three with their cameras, and five registered ones where the reference data are
	@echo; for report in $^; do echo "Open $(CURDIR)/$$report"; done

$(C)/data/images.csv: | $(STAMP)
	@test -d $(SHARED)/data/apollo15_cubes || $(PIP) --constraint constraints.txt --editable '.[data]'
	LUNARGR_SHARED=$(SHARED) $(BIN)/python examples/fetch_apollo15.py $(@D)

$(C)/scene.h5: $(C)/data/images.csv
	$(LUNARGR) ingest $(C)/data/dem.tif --images $< --gsd 316 --crop 32 -o $@ --overwrite

$(C)/crops.h5: $(C)/scene.h5
	$(LUNARGR) sample $< --crop 32 --count 900 --tile-m 11000 --split 60/15/25 -o $@ --overwrite

$(C)/pairs.h5: $(C)/crops.h5
	$(LUNARGR) project $< --register field --shifts $(C)/shifts.csv -o $@ --overwrite

$(C_RUNS): $(C)/checkpoint_%.h5: $(C)/pairs.h5
	$(LUNARGR) train $< --model kernels --epochs 10 --batch 8 --precision fp32 --seed $* -o $@ --overwrite --resume

$(C)/svbrdf.h5: $(C)/scene.h5 $(C)/checkpoint_0.h5
	$(LUNARGR) infer $^ -o $@ --overwrite

$(C_FOLDS): $(C)/fold_%.h5: $(C)/svbrdf.h5 $(C)/scene.h5
	$(LUNARGR) albedo $^ --fold $*/3 --register field --no-geotiff -o $@ --overwrite

$(C)/held_out.h5: $(C)/pairs.h5 $(C_FOLDS)
	$(LUNARGR) held-out $^ -o $@ --overwrite

$(C)/evaluation.h5: $(C)/pairs.h5 $(C_RUNS)
	$(LUNARGR) evaluate $^ -o $@ --figures $(C)/figures --overwrite

$(C)/report.html: $(C)/evaluation.h5 $(C)/held_out.h5
	$(LUNARGR) report $(C)/scene.h5 $(C)/crops.h5 $(C)/pairs.h5 $(C)/checkpoint_0.h5 $(C)/svbrdf.h5 $^ -o $@ \
	    --title "Apollo 15 metric camera cubes over GLD100" --overwrite

$(A)/scene.h5: | $(STAMP)
	@test -f $(A_DATA)/images.csv || { echo "reproduce-apollo15: no data at $(A_DATA); set LUNARGR_SHARED to the folder that holds data/apollo15"; exit 3; }
	$(LUNARGR) ingest $(A_DATA)/gld100_64ppd.tif --images $(A_DATA)/images.csv --gsd 474 --crop 48 -o $@ --overwrite

$(A)/crops.h5: $(A)/scene.h5
	$(LUNARGR) sample $< --count 3000 --tile-m 32000 --split 70/10/20 -o $@ --overwrite

# the frames were never orthorectified: relief displaces them, by up to 3 px
$(A)/pairs.h5: $(A)/crops.h5
	$(LUNARGR) project $< --register field -o $@ --overwrite

$(A_RUNS): $(A)/checkpoint_%.h5: $(A)/pairs.h5
	$(LUNARGR) train $< --model kernels --epochs 6 --precision fp32 --seed $* -o $@ --overwrite --resume

$(A)/svbrdf.h5: $(A)/scene.h5 $(A)/checkpoint_0.h5
	$(LUNARGR) infer $^ -o $@ --overwrite

$(A)/render.exr: $(A)/svbrdf.h5
	$(LUNARGR) render $< --subsolar-longitude 79 --subsolar-latitude 0.243 -o $@ --overwrite

# the map with albedo from all frames but one, for each of the five
$(A_FOLDS): $(A)/fold_%.h5: $(A)/svbrdf.h5 $(A)/scene.h5
	$(LUNARGR) albedo $^ --fold $*/5 --register field --no-geotiff -o $@ --overwrite

$(A)/held_out.h5: $(A)/pairs.h5 $(A_FOLDS)
	$(LUNARGR) held-out $^ -o $@ --overwrite

$(A)/evaluation.h5: $(A)/pairs.h5 $(A_RUNS)
	$(LUNARGR) evaluate $^ -o $@ --figures $(A)/figures --overwrite

$(A)/match.json: $(A)/pairs.h5 $(A)/checkpoint_0.h5
	$(LUNARGR) match $^ --count 12 --json $@ --figures $(A)/figures --overwrite

$(A)/diagnosis.h5: $(A)/scene.h5
	$(LUNARGR) sample $< --stack --count 24 --tile-m 32000 --split 70/10/20 -o $(A)/stack_crops.h5 --overwrite
	$(LUNARGR) project $(A)/stack_crops.h5 --exact -o $(A)/stack.h5 --overwrite
	$(LUNARGR) diagnose $(A)/stack.h5 --model hapke -o $@ --json $(A)/diagnosis.json --report $(A)/diagnosis.html --overwrite

$(A)/report.html: $(A)/evaluation.h5 $(A)/held_out.h5 $(A)/match.json $(A)/render.exr $(A)/diagnosis.h5
	$(LUNARGR) report $(A)/scene.h5 $(A)/crops.h5 $(A)/pairs.h5 $(A)/checkpoint_0.h5 $(A)/svbrdf.h5 $(A)/evaluation.h5 $(A)/held_out.h5 \
	    $(A)/match.json $(A)/diagnosis.json $(A)/render.png -o $@ --title "Apollo 15 metric camera over GLD100" --overwrite

# --- the paper's model comparison ----------------------------------------------------------------------------------

MODELS_PAIRS ?= $(D)/pairs.h5

reproduce-models: $(MODELS_PAIRS) ## train M1..M6, kernels and Hapke from three seeds on the same pairs; the paper's table with spreads
	$(LUNARGR) compare $< -o results/models --seeds 3 --epochs 4 --batch 8 --precision fp32 --json results/models.json --resume

clean: ## remove what the targets made, except .venv
	rm -rf demo demo-full results build *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
