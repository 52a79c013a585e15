# `make demo` and `make test` are all a newcomer needs; both create .venv first.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
SHELL := /bin/bash
export OMP_WAIT_POLICY := passive
# Containers often forbid Python to keep compiled modules: each of the hundreds of processes that tests start would compile them.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: venv demo test test-all faults lint matrix gui gpu-compile gpu-check bench benchmarks-page evidence evidence-page repository clean

venv: $(VENV)/.ready

# torch first: a looser pin of another package would pull gigabytes of CUDA libraries. Modules are compiled on all cores at the end,
# those that are templates or of another Python excepted; pip would use one.
$(VENV)/.ready: pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing. Install it (apt install python3.11 python3.11-venv) or set PYTHON=…"; exit 1; }
	$(PYTHON) -m venv $(VENV) || { echo "python3.11-venv is missing: apt install python3.11-venv"; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade "setuptools>=77" wheel
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -e ".[blender,dev]"
	@$(BIN)/python -m compileall -q -j 0 $(VENV)/lib > /dev/null || true
	@$(BIN)/python tests/system_libraries.py
	@touch $@

# PHOTOS=folder reconstructs your own photos (LABELS, CLASSES, MASKS optional); without it a museum scene is
# simulated and photographed first.
DEMO := build/demo$(if $(PHOTOS),-$(notdir $(patsubst %/images,%,$(patsubst %/,%,$(PHOTOS)))))
OWN := $(if $(LABELS),--labels "$(LABELS)") $(if $(CLASSES),--classes "$(CLASSES)") $(if $(MASKS),--masks "$(MASKS)")
SIMULATED := --labels $(DEMO)/capture/labels --classes $(DEMO)/capture/classes.json
TRAIN_SECONDS ?= 240

demo: venv
ifndef PHOTOS
	$(BIN)/fieldwork simulate $(DEMO)/capture --overviews 14
endif
	@rm -rf $(DEMO)/project || { sleep 5; rm -rf $(DEMO)/project; } || { \
		echo "$(DEMO)/project is still being written to by a demo that was stopped: run this again when that has ended." >&2; exit 1; }
	$(BIN)/fieldwork reconstruct "$(or $(PHOTOS),$(DEMO)/capture/photos)" --out $(DEMO)/project $(if $(PHOTOS),$(OWN),$(SIMULATED)) \
		--time-limit $(TRAIN_SECONDS) --blend $(DEMO)/scene.blend --report $(DEMO)/report.html --renders $(DEMO)/renders
	@echo "Look at $(DEMO)/report.html, $(DEMO)/scene.blend and $(DEMO)/renders."

# In two processes of 2.5 GB where there are two cores, WORKERS=0: in one. A worker takes whole files, whose tests share what
# they set up.
WORKERS ?= $(if $(filter 1,$(shell nproc 2>/dev/null || echo 1)),0,2)
test: venv
	$(BIN)/python -m pytest -m "not slow and not gui and not gpu" -n $(WORKERS) --dist loadfile $(PYTEST)

# Also the types of the systems that `.ci/run` leaves out.
test-all: venv types-Windows types-Darwin
	$(BIN)/python -m pytest $(PYTEST)

# Hundreds of faults (kills, damaged files, full disks, garbage), in 20 minutes; writes the table of docs/reliability.md.
SEED ?= 1
faults: venv
	$(BIN)/python -m fieldwork.tests.faults.campaign --seed $(SEED) --page docs/reliability.md $(FAULTS)

# With -j the types of several systems are checked side by side.
SYSTEMS ?= Linux Windows Darwin
lint: venv $(addprefix types-,$(SYSTEMS))
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

types-%: venv
	$(BIN)/pyright --pythonplatform $*

matrix: venv
	$(BIN)/python tests/addon/matrix.py

gui: venv
	$(BIN)/python -m pytest tests/gui $(PYTEST)

# Every kernel for every architecture without a GPU (minutes); writes the section Resources of docs/kernels.md.
gpu-compile: venv
	$(BIN)/python -m fieldwork.nerfcore.kernels.compile_cuda build/cubins --page docs/kernels.md

# Kernels against their twins, then training, rendering and memory; adds the figures to docs/figures and writes docs/benchmarks.md.
gpu-check: venv
	@$(BIN)/python -m fieldwork.nerfcore.bench.gpu_check $(BENCH)

# make bench SUITE=ablation BENCH="--seconds 60 --scenes museum"
SUITE ?= speed
bench: venv
	$(BIN)/fieldwork bench --suite $(SUITE) $(BENCH)

# docs/benchmarks.md anew from docs/figures, without measuring anything.
benchmarks-page: venv
	$(BIN)/python -m fieldwork.nerfcore.bench.page docs/benchmarks.md

# The published tables beside real baselines (docs/evidence.md): about 22 hours on four quiet cores, QUICK=1: a quarter of an hour,
# PROFILE=gpu: a GPU's. It can be stopped at any time and goes on with the trials that are missing.
PROFILE ?= $(if $(QUICK),quick,cpu)
evidence: venv
	$(BIN)/fieldwork bench --suite evidence --profile $(PROFILE) --page docs/evidence.md $(EVIDENCE)

# docs/evidence.md anew from docs/evidence, without measuring anything.
evidence-page: venv
	$(BIN)/python -m fieldwork.nerfcore.bench.evidence.page docs/evidence.md

repository: venv
	$(BIN)/python tests/addon/make_repository.py dist/repository

clean:
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache
