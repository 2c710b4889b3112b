# Everything goes through .venv; `make setup` makes it. Settings: PYTHON, TOILE_DATA.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# The first Python of at least 3.11; constraints.txt is made with 3.11.
PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)

export TOILE_DATA ?= data
# One thread: a second one gains nothing on these small systems, and costs a lot on a busy machine.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1

.PHONY: help
help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-15s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

.PHONY: setup
setup: $(READY) ## Make .venv with the pinned packages and toile itself

$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "error: no Python of at least 3.11 found; say make setup PYTHON=<path>" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@

.PHONY: demo
demo: setup ## Reconstruct a generated scene: table and result page
	@test -f "$(TOILE_DATA)/generated/demo/scene.json" || $(BIN)/toile generate preset=demo
	$(BIN)/toile fit experiment=demo

.PHONY: test
test: setup ## Run the tests; warnings are errors
	$(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadfile --durations=40 --durations-min=5

.PHONY: notebooks
notebooks: setup ## Run the notebooks; their outputs go to build/notebooks
	$(BIN)/python -W error notebooks/run.py

.PHONY: docs
docs: setup ## Build the documentation site, warnings are errors: build/site/index.html
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d build/doctrees docs build/site

.PHONY: lint
lint: setup ## Check style, types and the layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

.PHONY: format
format: setup ## Format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.PHONY: bench
bench: setup ## Measure speed and accuracy
	@{ echo '# Benchmarks (`make bench`)'; for file in benchmarks/bench_*.py; do echo; echo "## $$(basename $$file .py)"; echo; $(BIN)/python $$file; done; } | tee docs/results/benchmarks.md

.PHONY: linear-solvers
linear-solvers: setup ## Measure the linear solvers on grids and garments: docs/results/linear_solvers.md
	$(BIN)/python benchmarks/linear_solvers.py

.PHONY: results
results: setup ## Reproduce the table of the README (needs the recordings in TOILE_DATA)
	$(BIN)/python benchmarks/results.py

.PHONY: train-surrogate
train-surrogate: setup ## Train the neural surrogate on the CPU, then behind the line sweeps, and put its weights into the package (two hours)
	$(BIN)/toile train training=cpu threads=1 hydra.run.dir=outputs/surrogate
	cp outputs/surrogate/surrogate.pt src/toile/physics/surrogate/surrogate.pt
	$(BIN)/toile train training=further weights=packaged threads=1 hydra.run.dir=outputs/surrogate_further
	$(BIN)/python benchmarks/surrogate_further.py outputs/surrogate_further --ship

.PHONY: surrogate-card
surrogate-card: setup ## Measure the neural surrogate: docs/surrogate.md
	$(BIN)/python benchmarks/surrogate_card.py

.PHONY: surrogate-tradeoff
surrogate-tradeoff: setup ## Error over time of the surrogate beside Newton's method (ten minutes): docs/results/surrogate_tradeoff.md
	$(BIN)/python benchmarks/surrogate_tradeoff.py

.PHONY: surrogate-further
surrogate-further: setup ## Train the packaged surrogate further, and measure before and after (an hour): docs/results/surrogate_further.md; resumes
	test -f outputs/surrogate_further/surrogate.pt || $(BIN)/toile train training=further weights=packaged threads=1 hydra.run.dir=outputs/surrogate_further
	$(BIN)/python benchmarks/surrogate_further.py outputs/surrogate_further

.PHONY: simulators
simulators: setup ## Fit R1 and a generated scene with solver, hybrid and surrogate
	$(BIN)/python benchmarks/simulators.py

.PHONY: stability
stability: setup ## Fits 40 times longer than usual (SCENE=R1: half a day)
	$(BIN)/python benchmarks/stability.py $(if $(SCENE),--scene $(SCENE))

.PHONY: paper-recipe
paper-recipe: setup ## The paper's recipe on R1, one factor at a time (hours): docs/results/paper_recipe.md; resumes
	$(BIN)/python benchmarks/paper_recipe.py

.PHONY: base-law
base-law: setup ## Measure how far base laws miss cloth of an independent engine
	$(BIN)/python benchmarks/base_law.py --side 16 --output docs/results/base_law.md

.PHONY: model-grid
model-grid: setup ## Measure which grid the base model of a session needs (half an hour): docs/results/model_grid.md; resumes
	$(BIN)/python benchmarks/model_grid.py

.PHONY: capture-layer
capture-layer: setup ## The simulation layer of moving garments (an hour): docs/results/capture_layer.csv; resumes
	$(BIN)/python benchmarks/capture_layer.py

# A Python that has newton (pip install newton, in an environment of its own); nothing here depends on it.
NEWTON_PYTHON ?= $(BIN)/python

.PHONY: newton
newton: setup ## Our steps beside newton's vertex block descent, if it is there: docs/results/newton_vbd.md
	$(BIN)/python benchmarks/newton_vbd.py --python $(NEWTON_PYTHON)

.PHONY: capture-aliases
capture-aliases: setup ## What one camera can tell apart in a garment (minutes): docs/results/capture_aliases.md
	$(BIN)/python benchmarks/capture_aliases.py

.PHONY: capture-diagnosis
capture-diagnosis: setup ## Which effect a garment lacks, from masks alone (half an hour): docs/results/capture_diagnosis.md; resumes
	$(BIN)/python benchmarks/capture_diagnosis.py

.PHONY: capture-balance
capture-balance: setup ## Why a network's garment is out of balance (two minutes, after make capture-data): docs/results/capture_balance.md
	$(BIN)/python benchmarks/capture_balance.py

# One camera: PRESET=tiny learns nothing and is over in a minute. Everything goes on where it was interrupted.
PRESET ?= demo
CAPTURE := outputs/capture/$(PRESET)
CAPTURE_SEEDS ?= 0 1 2
# Ablations of the physics stage with every seed, and those with the first seed alone, which simulate most.
CAPTURE_ABLATIONS ?= eq8_alone potential_alone
CAPTURE_ABLATIONS_ONCE ?= no_silhouette_rays frames_2 frames_5 through_layer
CAPTURE_TABLE ?= docs/results/capture$(if $(filter demo,$(PRESET)),,_$(PRESET))
CAPTURE_DOMAINS ?= $(if $(filter tiny,$(PRESET)),,studio wild)
CAPTURE_FRAMES ?= $(if $(filter tiny,$(PRESET)),6,40)
capture = $(BIN)/toile capture $(1) preset=$(PRESET)
# Motions, repetitions and seed of a data set.
capture_data = $(call capture,data) folder=$(CAPTURE)/$(1) settings.motions=[$(2)] settings.repetitions=$(3) settings.seed=$(4) settings.n_frames=$(CAPTURE_FRAMES)
TRAINED_MOTIONS = $(if $(filter tiny,$(PRESET)),walk,walk$(comma)twirl$(comma)squat$(comma)turn)

.PHONY: capture-data
capture-data: setup
	$(if $(filter demo tiny,$(PRESET)),$(call capture_data,train,$(TRAINED_MOTIONS),$(if $(filter tiny,$(PRESET)),1,2),1),$(call capture,data) folder=$(CAPTURE)/train settings.seed=1 workers=-1)
	$(call capture_data,own,walk$(comma)squat,1,1000)

.PHONY: capture-demo
capture-demo: capture-data ## One camera to body and garment, from nothing to a page (ten minutes): data, training, run; resumes
	$(call capture,physics) folder=$(CAPTURE)/train output=$(CAPTURE)/seed0
	$(call capture,run) run=$(CAPTURE)/own weights=$(CAPTURE)/seed0/physics/weights.pt result=$(CAPTURE)/run

.PHONY: capture-weights
capture-weights: setup ## The package's networks out of make capture-demo, in half precision
	$(BIN)/python benchmarks/capture_weights.py --weights $(CAPTURE)/seed0/physics/weights.pt

.PHONY: capture-tables
capture-tables: capture-data ## One camera: training with three seeds, ablations, baselines (hours): docs/results/capture.csv; resumes
	$(call capture_data,unseen,kick,1,1000)
	$(foreach stage,$(CAPTURE_DOMAINS),$(call capture,data) domain=blender domain/stage=$(stage) folder=$(CAPTURE)/$(stage) settings.motions=[walk] settings.n_frames=24 settings.seed=2000 && )true
	set -e; for seed in $(CAPTURE_SEEDS); do \
		place=$(CAPTURE)/seed$$seed; training="folder=$(CAPTURE)/train seed=$$seed"; \
		$(call capture,physics) $$training output=$$place; \
		ablations="$(CAPTURE_ABLATIONS)"; \
		if [ $$seed = $(firstword $(CAPTURE_SEEDS)) ]; then ablations="$$ablations $(CAPTURE_ABLATIONS_ONCE)"; fi; \
		for ablation in $$ablations; do \
			$(call capture,physics) $$training output=$$place ablation=$$ablation; done; \
		for ablation in one_piece coarse_graph; do \
			$(call capture,warm) $$training output=$$place/$$ablation ablation=$$ablation weights=$$place/pose/weights.pt; done; \
		for domain in $(CAPTURE_DOMAINS); do \
			$(call capture,adapt) seed=$$seed output=$$place/$$domain run=$(CAPTURE)/$$domain/000-walk weights=$$place/physics/weights.pt; done; \
		for clip in $(CAPTURE)/own/0*; do \
			$(call capture,adapt) seed=$$seed output=$$place/own run=$$clip weights=$$place/physics/weights.pt; done; \
	done
	$(call capture,tables) tables.trained=$(CAPTURE) tables.output=$(CAPTURE_TABLE) every=4 \
		tables.seeds=[$(call list,$(CAPTURE_SEEDS))] tables.ablations_on=[own] tables.domains.own=[$(CAPTURE)/own] tables.domains.unseen=[$(CAPTURE)/unseen] \
		$(foreach stage,$(CAPTURE_DOMAINS),tables.domains.$(stage)=[$(CAPTURE)/$(stage)]) \
		"tables.note='make capture-tables: preset $(PRESET), seeds $(CAPTURE_SEEDS), held-out clips.'"

.PHONY: session-ladder
session-ladder: setup ## Where a diagnosis of several clips loses what they know (hours): docs/results/session_ladder.md; resumes
	$(BIN)/python benchmarks/session_ladder.py

.PHONY: session-time
session-time: setup ## Time and memory of a diagnosis of one clip, by one process and by two (15 minutes): docs/results/session_time.md
	$(BIN)/python benchmarks/session_time.py

.PHONY: torque-balance
torque-balance: setup ## What the balance of torques knows of causes from outside (an hour): docs/results/torque_balance.md; resumes
	$(BIN)/python benchmarks/torque_balance.py

.PHONY: outside-causes
outside-causes: setup ## What clips say of causes from outside, forces within free (hours): docs/results/outside_causes.md; resumes
	$(BIN)/python benchmarks/outside_causes.py

.PHONY: robustness
robustness: setup ## Give every command bad input: docs/robustness.md; resumes
	$(BIN)/python benchmarks/robustness.py

# Ablations: what a sweep covers. RECIPE=tracking is the default recipe, paper the paper's with its network
# (PROTOCOL=short: first 20 frames, 60 cycles; whole: 50 frames, 250 cycles, a night for R1), adam the paper's optimisation in ours.
# Nothing in the latter two is random: one fit, measured with every seed.
RECIPE ?= tracking
PROTOCOL ?= short
SCENES ?= R1
SEEDS ?= 0 1 2
GENERATED ?= standard swung shaken
GENERATED_SEEDS ?= 0
GENERATED_FRAMES ?= 25
JOBS ?= -1
PAPER_ABLATIONS := none no_silhouette no_force_regularization no_turbulence no_uv no_successive
ABLATIONS ?= $(PAPER_ABLATIONS) $(if $(filter tracking,$(RECIPE)),no_calibration) $(if $(filter-out paper,$(RECIPE)),\
	surrogate hybrid backward_euler one_step_per_frame uniform_rest_lengths uv_from_file supersampled_renderer)
ABLATION_SCENES := outputs/ablations/scenes
SWEEP := outputs/ablations/$(RECIPE)$(if $(filter paper,$(RECIPE)),_$(PROTOCOL))
TABLE ?= ablations_$(RECIPE)$(if $(filter paper_whole,$(RECIPE)_$(PROTOCOL)),_whole)
comma := ,
empty :=
list = $(subst $(empty) $(empty),$(comma),$(strip $(1)))
ifeq ($(RECIPE),paper)
RECIPE_SETTINGS := experiment=paper_network$(if $(filter short,$(PROTOCOL)),_short)
else
RECIPE_SETTINGS := optimization=$(RECIPE)
SHORT_CLIP := scene.n_frames=$(GENERATED_FRAMES)
endif
ifeq ($(RECIPE),tracking)
FIT_SEEDS = $(1)
else
FIT_SEEDS = $(firstword $(1))
MEASURED := "seeds=[$(call list,$(SEEDS))]" "published=[R3,R4,R5,R7,R8,R9]"
endif
sweep = $(if $(strip $(1)),$(BIN)/toile fit -m hydra=ablations hydra.sweep.dir=$(SWEEP) hydra.launcher.n_jobs=$(JOBS) report.video=false $(3) \
	$(RECIPE_SETTINGS) ablation=$(call list,$(ABLATIONS)) scene=$(call list,$(1)) seed=$(call list,$(call FIT_SEEDS,$(2))) || status=$$?;)

$(ABLATION_SCENES)/%/scene.json: | $(READY)
	$(BIN)/toile generate preset=$* folder=$(@D)

.PHONY: ablations
ablations: setup $(GENERATED:%=$(ABLATION_SCENES)/%/scene.json) ## Fit with one part removed at a time: docs/results/ablations_*; runs what is missing
	@status=0; $(call sweep,$(SCENES),$(SEEDS)) $(call sweep,$(GENERATED:%=$(ABLATION_SCENES)/%),$(GENERATED_SEEDS),$(SHORT_CLIP)) \
	$(BIN)/toile tables $(SWEEP) name=$(TABLE) output=docs/results $(MEASURED) \
		note="'Made by \`make ablations RECIPE=$(RECIPE)$(if $(filter paper,$(RECIPE)), PROTOCOL=$(PROTOCOL))\`: $(call list,$(ABLATIONS)) on $(call list,$(SCENES) $(GENERATED)); what is not in a table has not run.'"; exit $$status

# Blind check of the diagnosis: BLIND=tiny, standard or full. A new set every time: BLIND_NAME is its folder.
BLIND ?= standard
BLIND_NAME ?= $(BLIND)
BLIND_SET = blind=$(BLIND) name=$(BLIND_NAME) jobs=$(JOBS)

.PHONY: r1-diagnosis
r1-diagnosis: setup ## Diagnose R1, held-out frames against the depth camera: docs/results/r1_diagnosis.md (needs R1 in TOILE_DATA)
	$(BIN)/python benchmarks/r1_diagnosis.py

.PHONY: independent
independent: setup ## Diagnose the scenes of the independent engine: docs/results/independent.md (needs them in TOILE_DATA)
	$(BIN)/python benchmarks/independent.py

.PHONY: independent-sessions
independent-sessions: setup ## The same, each as a session of one clip, and R1: docs/results/independent_sessions.md; resumes
	$(BIN)/python benchmarks/independent.py --sessions

.PHONY: blind
blind: setup ## Make scenes with sealed labels, diagnose them, open the labels: the table of measures; resumes
	$(BIN)/toile blind make $(BLIND_SET)
	$(BIN)/toile blind run $(BLIND_SET)
	$(BIN)/toile blind grade $(BLIND_SET)
	$(if $(filter standard,$(BLIND)),$(BIN)/python benchmarks/blind_results.py $(BLIND_NAME))

SESSIONS ?= sessions
SESSIONS_TABLE = $(if $(filter sessions sessions_short,$(SESSIONS)),table=docs/results/blind_$(SESSIONS:sessions=sessions_sixty).csv)

.PHONY: blind-sessions
blind-sessions: setup ## The same with sessions of several clips: three clips, one alone, one more as asked for; resumes
	$(BIN)/toile blind make set=$(SESSIONS) jobs=$(JOBS)
	$(BIN)/toile blind run set=$(SESSIONS) jobs=$(JOBS)
	$(if $(filter sessions_short,$(SESSIONS)),,$(BIN)/toile blind run set=$(SESSIONS) jobs=$(JOBS) one_clip=true)
	$(BIN)/toile blind run set=$(SESSIONS) jobs=$(JOBS) as_scene=true
	$(BIN)/toile blind extend set=$(SESSIONS)
	$(BIN)/toile blind run set=$(SESSIONS) jobs=$(JOBS) extended=true
	$(BIN)/toile blind grade set=$(SESSIONS) $(SESSIONS_TABLE)

.PHONY: blind-sessions-short
blind-sessions-short: ## Sessions of one clip of 40 frames at 25 a second, then with the clip that each answer asks for; resumes
	$(MAKE) blind-sessions SESSIONS=sessions_short

.PHONY: blind-sessions-pooled
blind-sessions-pooled: setup ## All sealed sessions so far in one table: docs/results/blind_sessions_pooled.md
	$(BIN)/python benchmarks/blind_sessions_pooled.py

.PHONY: blind-results
blind-results: setup ## Put a graded set (BLIND_NAME) into the documents: docs/results/blind_standard.md
	$(BIN)/python benchmarks/blind_results.py $(BLIND_NAME)

.PHONY: development
development: setup ## Scenes with open labels for the diagnosis: docs/results/diagnosis_development.md; resumes
	$(BIN)/python benchmarks/development.py

.PHONY: effects
effects: setup ## Does every effect find its own numbers again? docs/results/effects.md
	$(BIN)/python benchmarks/effects.py

.PHONY: templates
templates: setup ## Find the published templates again from meshes and points (needs the recordings in TOILE_DATA)
	$(BIN)/python benchmarks/templates.py

.PHONY: masks
masks: setup ## Measure how well a cloth is cut out of a clip: docs/results/masks.md
	$(BIN)/python benchmarks/masks.py

.PHONY: dashboard
dashboard: setup ## Show the runs in outputs/ in TensorBoard (RUNS=folder: those below it)
	$(BIN)/tensorboard --logdir $(or $(RUNS),outputs)

.PHONY: screenshots
screenshots: setup ## Make the documentation's pictures of pages (needs a Chromium)
	$(BIN)/python docs/images/make_screenshots.py

.PHONY: constraints
constraints: setup ## Pin what is installed in .venv
	@{ grep '^#' constraints.txt; $(BIN)/python -m pip freeze --exclude-editable | sed -E 's/\+[a-z0-9.]+$$//'; } > .constraints.new
	@mv .constraints.new constraints.txt && touch $(READY)

.PHONY: clean
clean: ## Remove caches and build products; outputs, data and .venv stay
	rm -rf build dist docs/notebooks .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
	find src tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
