# Two commands for everyone: `make run` and `make test`. Both set up .venv by themselves; the second time they are quicker.
.DEFAULT_GOAL := help
SHELL := /bin/bash

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
TORCH ?= $(shell sed -n 's/^torch==//p' constraints.txt)
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu
CONSTRAINTS ?= constraints.txt
LOCKED := $(if $(CONSTRAINTS),-c $(CONSTRAINTS))
JOBS ?= 2
SPLIT ?= quickstart
SEEDS ?= range(3)
FUZZ ?= 3000
KILLS ?= 100
PILOTS ?= build/pilots
SEED ?= 0
MINUTES ?= 30
# Byte code of the tests is kept: without it each process that runs them compiles them anew, 10 to 15 s.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: reference_minutes help install run test test-durations lint test-apart test-page test-export test-cluster bench-launchers export_all test-docs test-fuzz test-wheel test-processes test-studies test-slow ui docs reference docs-site screenshots notebooks example_log clean ferrari_drive ksnn learned_ukf learned_ukf_quick heavy_ekf cnn_ukf scorecard planted_truth error_traces proving_ground real_cars leave_one_out sim_to_real trust online_faults own_car_proposals front_door own_car pretrained unseen_car unseen_car_planted unseen_car_record sweep bench-training bench-ingest bench-simulation bench-ksnn bench-ukf bench-ekf bench-cnn bench-trust bench-health bench-workflow replay_check replay_30min examples fuzz kills interrupts golden lock pilots pilots-compare friction_slip

help: ## list the targets
	@grep -hE '^[a-z0-9_-]+:.*?## ' $(MAKEFILE_LIST) | awk -F':.*?## ' '{printf "  make %-16s %s\n", $$1, $$2}'

install: $(INSTALLED) ## set up .venv (GPU=1 for a CUDA build of torch)

# Versions are those of constraints.txt; `make install CONSTRAINTS=` takes the newest ones instead.
# The CPU build of torch where there is one: no CUDA download on a machine without a GPU.
$(INSTALLED): pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "vehest needs Python 3.11 or newer; set PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
ifeq ($(GPU),1)
	$(BIN)/python -m pip install -q $(LOCKED) "torch>=2.6"
else
	$(BIN)/python -m pip install -q $(LOCKED) "torch==$(TORCH)+cpu" 2>/dev/null \
	  || $(BIN)/python -m pip install -q $(LOCKED) "torch>=2.6" --index-url $(TORCH_CPU_INDEX) 2>/dev/null \
	  || { echo "warning: no CPU build of torch found, installing the default one, which may bring CUDA along"; \
	       $(BIN)/python -m pip install -q $(LOCKED) "torch>=2.6"; }
endif
	$(BIN)/python -m pip install -q $(LOCKED) -e ".[dev]"
	touch $@

run: $(INSTALLED) ## train and compare four families on simulated drives (after installing, three minutes of processor time the first time, seconds when repeated)
	$(BIN)/vehest run pipelines/quickstart.yaml

test: $(INSTALLED) ## tests; studies are in `make test-apart`, style and types in `make lint`
	$(TESTS)

test-durations: $(INSTALLED) ## the same, with the 50 that take longest
	$(TESTS) --durations=50

test-apart: $(INSTALLED) ## tests that are slow by nature: studies, among them those of the papers, documentation, fuzzing, the wheel, many processes
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "apart and not slow"

test-docs test-fuzz test-wheel test-processes test-studies: $(INSTALLED) ## one kind of them
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "apart and not slow" $(TESTS_$(@:test-%=%))

test-export: $(INSTALLED) ## models in C under compilers, sanitizers, MISRA rules and emulators, as far as these are installed (15 minutes)
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -rs -m "export and not slow" tests/export

test-cluster: $(INSTALLED) ## trainings on two Ray nodes of this machine, workers and a node killed in the middle, and as SLURM jobs (10 minutes); installs Ray and submitit
	$(BIN)/python -m pip install -q $(LOCKED) -e ".[cluster-tests]"
	$(BIN)/python -m pytest -rs -m "cluster and not slow" tests/cluster

test-page: $(INSTALLED) ## report pages in headless Chromium (Debian: chromium chromium-driver); skipped without it
	$(BIN)/python -m pytest -m "page and not slow" -rs tests/report/test_page.py tests/test_site.py

TESTS = $(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow and not apart and not page and not export and not cluster"
TESTS_docs := tests/test_docs.py tests/test_shown_commands.py tests/test_examples.py tests/test_notebooks.py
TESTS_fuzz := tests/fuzz
TESTS_wheel := tests/test_wheel.py
TESTS_processes := tests/run/test_locks.py tests/run/test_tracking.py
TESTS_studies := tests/golden tests/papers tests/report tests/run --ignore=tests/run/test_locks.py --ignore=tests/run/test_tracking.py

lint: $(INSTALLED) ## style, types, layers of imports, published results that are stale
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy docs/*.py tools/*.py
	$(BIN)/lint-imports
	$(BIN)/vehest report --check
	$(BIN)/python -m vehest_papers.scorecard --check

test-slow: $(INSTALLED) ## the studies behind the tests; needs VEHEST_DATA for the real recordings
	$(BIN)/python -m pytest -m slow

golden: $(INSTALLED) ## record the numbers that the golden tests compare, after a version was raised
	PYTHONPATH=tests $(BIN)/python tests/golden/golden_defaults.py
	PYTHONPATH=tests:tests/sources $(BIN)/python tests/golden/golden_numbers.py
	PYTHONPATH=tests:tests/sources $(BIN)/python tests/golden/golden_readings.py

pilots: $(INSTALLED) ## every study on small budgets, its tables in build/pilots (PILOTS=FOLDER, STUDIES="ksnn trust"); needs VEHEST_DATA
	nice $(BIN)/python tests/pilots/pilots.py $(STUDIES) --out $(PILOTS) --jobs $(JOBS)

pilots-compare: $(INSTALLED) ## tables of two such runs, cell by cell (A=FOLDER B=FOLDER)
	$(BIN)/python tests/pilots/pilots.py --compare $(A) $(B)

kills: $(INSTALLED) ## kill the quickstart 100 times (KILLS=100, SEED=0), every run after it must end in the same numbers; half an hour
	PYTHONPATH=tests $(BIN)/python tests/kills/kills.py --kills $(KILLS) --seed $(SEED)

interrupts: $(INSTALLED) ## press Ctrl-C 50 times (SEED=0) in the first 5 s of the quickstart, while workers start; every run must end; ten minutes
	PYTHONPATH=tests $(BIN)/python tests/kills/interrupts.py --seed $(SEED)

fuzz: $(INSTALLED) ## try 3,000 malformed inputs on the command line, a row each in results/reliability/fuzz.csv (FUZZ=3000, SEED=0; ten minutes)
	PYTHONPATH=tests:tests/sources $(BIN)/python -m fuzz --inputs $(FUZZ) --seed $(SEED) --jobs $(JOBS) --out results/reliability/fuzz.csv

ui: $(INSTALLED) ## look at all runs in MLflow
	$(BIN)/mlflow ui --backend-store-uri "sqlite:///$$(realpath "$${VEHEST_OUTPUT:-outputs}")/mlflow.db"

docs: reference docs-site ## the reference pages that are made from the code and results, then the site of all pages

reference: $(INSTALLED)
	$(BIN)/python docs/make_reference.py
	$(BIN)/python tools/make_configuration.py

docs-site: $(INSTALLED) ## a site of all pages in build/site, every warning an error, every local link tried
	$(BIN)/sphinx-build -q -W --keep-going -b html -c docs . build/site
	$(BIN)/python docs/check_site.py build/site

screenshots: $(INSTALLED) docs-site ## pictures of the quickstart's page and of the site, in docs/images; needs Chromium
	$(BIN)/vehest run quickstart tracking=none
	PYTHONPATH=tests $(BIN)/python tests/screenshots.py "$$(ls -td "$${VEHEST_OUTPUT:-outputs}"/report/quickstart-*/ | head -1)report.html" build/site docs/images

notebooks: $(INSTALLED) ## run the notebooks of examples/ and store what their cells show (a minute)
	$(BIN)/python tools/run_notebooks.py

example_log: $(INSTALLED) ## docs/examples/lap.csv, the log of the how-to guides: four minutes of a simulated Ferrari 250 LM
	$(BIN)/vehest downsample sim_quickstart rate_hz=20 vehicle@dataset.vehicle=ferrari_250_lm \
	  'dataset.drives=[{id: lap, seed: 7, manoeuvre: {name: laps, course: palm_beach_like, duration: 240, severity: [0.92, 1.0]}}]'
	$(BIN)/python tools/make_example_log.py "$$(ls -t "$${VEHEST_OUTPUT:-outputs}"/downsample/sim_quickstart-20hz-*/lap.parquet | head -1)"

ferrari_drive: $(INSTALLED) ## the study on the real Ferrari recording; needs VEHEST_DATA
	$(BIN)/vehest run pipelines/ferrari_drive.yaml

ksnn: $(INSTALLED) ## every claim of the KS-NN paper, on simulated cars and, with VEHEST_DATA, on real ones: hours
	$(BIN)/vehest run pipelines/ksnn.yaml

learned_ukf: $(INSTALLED) ## the tables and figures of the learned UKF's paper, on real tyre sets; needs VEHEST_DATA, and about a day on two cores
	$(BIN)/vehest run pipelines/learned_ukf.yaml

learned_ukf_quick: $(INSTALLED) ## NNTF_UH, PC and GRU trained anew, one seed each, and whether their order is the published one; needs VEHEST_DATA, 15 min on two cores
	$(BIN)/vehest run pipelines/learned_ukf_quick.yaml --json tracking=none | $(BIN)/python -m vehest_papers.learned_ukf.order

heavy_ekf: $(INSTALLED) ## a heavy vehicle by Kalman filters whose tyres adapt: laps, a map of slip and stiffness, and the real Ferrari and AV-21 with VEHEST_DATA; at most 5 h on two cores, continues where it was stopped
	$(BIN)/vehest run pipelines/heavy_ekf.yaml

cnn_ukf: $(INSTALLED) ## the UKF-informed network's paper claim by claim on new simulated manoeuvres: about 15 h on one core if nothing is published, continues where it was stopped
	$(BIN)/vehest run pipelines/cnn_ukf.yaml

scorecard: $(INSTALLED) ## four papers, published and ours, from committed claims and errors by block: results/scorecard.md (seconds)
	$(BIN)/python -m vehest_papers.scorecard

planted_truth: $(INSTALLED) ## how often the scorecard's verdicts are right: 18,000 simulated studies composed of real errors (minutes)
	$(BIN)/python -m vehest_papers.planted_truth

error_traces: ferrari_drive ## the real errors that planted_truth is made of, from the study before; needs VEHEST_DATA
	$(BIN)/python -m vehest_papers.planted_truth --evaluations "$${VEHEST_OUTPUT:-outputs}/evaluate"

proving_ground: $(INSTALLED) ## simulated cars compared with papers and a real recording (VEHEST_DATA, if you have it)
	$(BIN)/vehest run pipelines/proving_ground.yaml

real_cars: $(INSTALLED) ## what the real recordings contain, and which can rank estimators; needs VEHEST_DATA
	$(BIN)/vehest run pipelines/real_cars.yaml

leave_one_out: $(INSTALLED) ## each vehicle tested by estimators that were trained on others; needs VEHEST_DATA, and half an hour
	$(BIN)/vehest run pipelines/leave_one_out.yaml

sim_to_real: $(INSTALLED) ## from simulated cars to the real Ferrari; needs VEHEST_DATA
	$(BIN)/vehest run pipelines/sim_to_real.yaml

reference_minutes: $(INSTALLED) ## how many minutes of reference an estimator needs; needs VEHEST_DATA (half an hour on two cores)
	$(BIN)/vehest run pipelines/reference_minutes.yaml

trust: $(INSTALLED) ## coverage of bands and detection of faults; needs VEHEST_DATA, and an hour
	$(BIN)/vehest run pipelines/trust.yaml

online_faults: $(INSTALLED) ## every family online under every fault, one row per case; with VEHEST_DATA also on real recordings; half an hour
	$(BIN)/python tests/faults/online_faults.py --out results/reliability/online_faults.csv

own_car_proposals: $(INSTALLED) ## columns that vehest new proposes for twelve logs, compared with the right ones: results/own_car/proposals.csv; needs VEHEST_DATA
	PYTHONPATH=tests/proposals $(BIN)/python tests/proposals/own_car_proposals.py --out results/own_car/proposals.csv

front_door: $(INSTALLED) ## ten logs as users bring them, from vehest new to a verdict; needs VEHEST_DATA (40 minutes)
	PYTHONPATH=tests/proposals $(BIN)/python tests/proposals/front_door.py

friction_slip: $(INSTALLED) ## how much the estimated friction widens the learned UKF's bands: two trainings on simulated tyres, then drives on others (20 minutes)
	VEHEST_OUTPUT=$${VEHEST_OUTPUT:-outputs}/friction_slip $(BIN)/vehest sweep split=sim_tyre_sets estimator=learned_ukf training.one_step.max_epochs=500 \
	  training.through.max_epochs=300 training.batch_size=6 training.through.learning_rate=2.0e-3 'seed=0,1' tracking=none
	$(BIN)/python tools/choose_friction_slip.py "$${VEHEST_OUTPUT:-outputs}"/friction_slip/train/learned_ukf-nntf_uh-seed*

unseen_car: $(INSTALLED) ## the self-calibrating filter on cars that were not used for training (results/unseen_car); needs VEHEST_DATA, and committed choices
	$(BIN)/python tools/unseen_car.py

unseen_car_planted: $(INSTALLED) ## the same filter on 200 drawn cars in town and 100 at the limit, simulated (results/unseen_car/drawn_cars.md)
	$(BIN)/python tools/unseen_car_planted.py

unseen_car_record: $(INSTALLED) ## vehest identify on drives of one car, on 200 planted cars and in scenes (results/unseen_car/record.md); needs VEHEST_DATA
	$(BIN)/python tools/unseen_car_record.py

pretrained: sim_to_real ## the models for cars without a training of their own, from the study sim_to_real
	$(BIN)/python tools/make_pretrained.py

sweep: $(INSTALLED) ## KS-NN over P and Q with intervals over seeds (SPLIT=quickstart, simulated; SEEDS="range(3)")
	$(BIN)/vehest sweep split=$(SPLIT) estimator=ksnn estimator.n_local=2,3,4,5,6 estimator.n_hidden=0,1,2,3 estimator.bias=true,false \
	  'seed=$(SEEDS)' training.max_epochs=60 tracking=none

bench-training: $(INSTALLED) ## compiled recursions and batched trainings against plain PyTorch
	$(BIN)/python benchmarks/training.py

bench-ksnn: $(INSTALLED) ## 64 seeds of a KS-NN trained together against one after another in plain PyTorch
	$(BIN)/python benchmarks/ksnn.py

bench-ukf: $(INSTALLED) ## a training step through the unscented filter against plain PyTorch, online steps (VEHEST_DATA, if you have it; minutes)
	$(BIN)/python benchmarks/ukf.py

bench-ingest: $(INSTALLED) ## one official Revs file of 791,000 rows x 55 columns against a bare pyarrow.csv.read_csv
	$(BIN)/python benchmarks/ingest.py

bench-simulation: $(INSTALLED) ## the compiled plant against plain Python, data sets on all cores against one (10 minutes)
	$(BIN)/python benchmarks/simulation.py

bench-trust: $(INSTALLED) ## time of contract, band and health, for a step online and a minute in batch, against the estimator alone
	$(BIN)/python benchmarks/trust.py

bench-health: $(INSTALLED) ## alarms of health per hour against detected faults, for several limits; needs VEHEST_DATA (15 minutes on one core)
	$(BIN)/python benchmarks/health_statistics.py

bench-ekf: $(INSTALLED) ## ten hours at 20 Hz through the compiled rational EKF, against the same filter step by step
	$(BIN)/python benchmarks/ekf.py

bench-launchers: $(INSTALLED) ## overhead of a task in the local launcher and in Ray, and the length from which a second node is faster; installs Ray (10 minutes)
	$(BIN)/python -m pip install -q $(LOCKED) -e ".[ray]"
	$(BIN)/python benchmarks/launchers.py

replay_check: $(INSTALLED) ## models on the frames of a bus against themselves offline, on the real Ferrari's test range; needs VEHEST_DATA
	$(BIN)/python benchmarks/replay.py check

replay_30min: $(INSTALLED) ## 30 minutes of a bus at 100 Hz in real time: deadlines and memory; on an idle machine, or under chrt -f 50 (MINUTES=30)
	$(BIN)/python benchmarks/replay.py soak --minutes $(MINUTES)

own_car: $(INSTALLED) ## from a raw CSV of the real Ferrari to a verdict, timed: vehest new, then vehest run --minutes 15; needs VEHEST_DATA
	$(BIN)/python benchmarks/own_car.py

export_all: $(INSTALLED) ## every family in C against Python: digits, time, bytes; with VEHEST_DATA and trained models also over real drives
	$(BIN)/python benchmarks/export.py --out results/export

examples: $(INSTALLED) ## the worked examples of docs/adding_an_estimator.md trained and compared on the quickstart's drives (minutes; the first time kernels are compiled)
	$(BIN)/python tools/compare_examples.py

bench-workflow: $(INSTALLED) ## a finished study run again, estimates of a minute and of 15 hours, against loading libraries and reading the file
	$(BIN)/python benchmarks/workflow.py

bench-cnn: $(INSTALLED) ## training through the filter and twenty networks together, against plain PyTorch (minutes)
	$(BIN)/python benchmarks/cnn_ukf.py

lock: $(INSTALLED) ## write the installed versions to constraints.txt (after make install CONSTRAINTS=); raise versions of code whose numbers moved
	$(BIN)/python -m pip install -q -e ".[dev,ray,slurm,bench]"
	$(BIN)/python -m pip freeze --exclude-editable | sed -E '/ @ |^(pip|setuptools|wheel|nvidia-.*|cuda-.*|triton)==/d; s/^(torch==[^+]*).*/\1/' > constraints.txt

clean: ## remove generated files (not outputs/)
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
