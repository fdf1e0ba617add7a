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
SHARED := $(or $(LUNARGR_SHARED),$(abspath ../shared))

.PHONY: help install demo test test-slow lint bench campaign reproduce-apollo15 reproduce-models docs clean

help: ## list the targets
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-20s %s\n", $$1, $$2}'

install: $(STAMP) ## create .venv with the lunargr command

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "lunargr needs Python >= 3.11; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	@# torch first and pinned: the CPU build, where the registry has one, instead of gigabytes of CUDA packages
	$(BIN)/python -m pip install --quiet $$(grep '^torch==' constraints.txt)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[test,lint]'
	@touch $@

# --- the embedded scene --------------------------------------------------------------------------------------------

D := demo
DEMO_TRAIN := --epochs 8 --batch 32 --lr 1e-3 --schedule cosine

demo: $(D)/report.html ## run every stage on the embedded scene and name a report to open
	@echo; echo "Open $(abspath $(D)/report.html)"

$(D)/scene/images.csv: | $(STAMP)
	$(LUNARGR) simulate -o $(D)/scene --overwrite

$(D)/scene.h5: $(D)/scene/images.csv
	$(LUNARGR) ingest $(D)/scene/dem.tif --images $(D)/scene/images.csv --gsd 5 -o $@ --overwrite

$(D)/crops.h5: $(D)/scene.h5
	$(LUNARGR) sample $< --count 1600 -o $@ --overwrite

$(D)/pairs.h5: $(D)/crops.h5
	$(LUNARGR) project $< -o $@ --overwrite

$(D)/checkpoint.h5: $(D)/pairs.h5
	$(LUNARGR) train $< --model M2 $(DEMO_TRAIN) -o $@ --overwrite --resume

$(D)/svbrdf.h5: $(D)/scene.h5 $(D)/checkpoint.h5
	$(LUNARGR) infer $^ -o $@ --overwrite

# --- real photographs: Apollo 15 metric camera frames over the GLD100 elevation model ------------------------------

A := results/apollo15
A_DATA := $(SHARED)/data/apollo15

$(A)/scene.h5: | $(STAMP)
	@test -f $(A_DATA)/images.csv || { echo "reproduce-apollo15: no data at $(A_DATA); set LUNARGR_SHARED to the folder that holds data/apollo15"; exit 3; }
	$(LUNARGR) ingest $(A_DATA)/gld100_64ppd.tif --images $(A_DATA)/images.csv --gsd 474 --crop 64 -o $@ --overwrite

$(A)/crops.h5: $(A)/scene.h5
	$(LUNARGR) sample $< --count 2500 --tile-m 45000 -o $@ --overwrite

$(A)/pairs.h5: $(A)/crops.h5
	$(LUNARGR) project $< -o $@ --overwrite

$(A)/checkpoint.h5: $(A)/pairs.h5
	$(LUNARGR) train $< --model M2 --epochs 40 --batch 32 --lr 5e-4 --schedule cosine -o $@ --overwrite --resume

$(A)/svbrdf.h5: $(A)/scene.h5 $(A)/checkpoint.h5
	$(LUNARGR) infer $^ -o $@ --overwrite

clean: ## remove what the targets made, except .venv
	rm -rf demo results build *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
