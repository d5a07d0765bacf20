# make run [VIDEO=dance.mp4]   the environment, the models, and the flow on a video (or on a synthetic clip)
# make test                    the environment and the tests; HUGS_CLIPS=FOLDER names real clips, without it their tests are skipped
# make quick                   the tests that take under a second each (WORKERS=2 processes, as with make test)
# make hard                    the numerical hard cases: what holds each, how far from its bound
# make lowest                  the oldest versions that pyproject.toml allows, in build/lowest; tests of films, masks and `ci` on them
# make mutants                 takes stabilisers out, one by one, and shows that a test notices; FILE=stages/x.py: mistakes in that file
# make table                   clips of HUGS_CLIPS x pipelines: docs/benchmarks/table.json, its page and plot; ONLY="--clips kitchen"
# make gallery                 docs/gallery/: pictures of the runs that make table left; or of others: RUNS="kitchen=work/kitchen/default"
# make bench WORK=work/kitchen/default   how fast it is here, with what that pipeline left; JSON in build/
PYTHON ?= python3
VENV   ?= .venv
WORKERS ?= 2
unexport PYTHONDONTWRITEBYTECODE  # else each of the many processes compiles all modules again
HUGS    = $(VENV)/bin/hugs
PYTEST  = $(VENV)/bin/python -m pytest --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder

run: $(VENV)/ready
	@$(HUGS) doctor --fetch
	@$(if $(VIDEO),$(HUGS) run "$(VIDEO)",$(HUGS) demo)

test: $(VENV)/ready
	$(HUGS) doctor --fetch
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/lint-imports
	{ $(VENV)/bin/mypy && $(VENV)/bin/mypy --strict --follow-imports silent --cache-dir .mypy_cache/strict examples; } & types=$$!; $(PYTEST) --durations=40; tests=$$?; wait $$types && exit $$tests

quick: $(VENV)/ready
	$(PYTEST) -m "not slow"

hard: $(VENV)/ready
	$(VENV)/bin/python -m tests.tools.hard_cases

mutants: $(VENV)/ready
	$(VENV)/bin/python -m tests.tools.mutants $(FILE)

lowest: $(VENV)/ready
	$(VENV)/bin/python -m tests.tools.lowest

bench: $(VENV)/ready
	@mkdir -p build
	$(VENV)/bin/python -m tests.benchmarks.rasterizer --work $(WORK) --json build/rasterizer.json
	$(VENV)/bin/python -m tests.benchmarks.train_step $(WORK) --json build/train_step.json
	$(VENV)/bin/python -m tests.benchmarks.render $(WORK) --json build/render.json

table: $(VENV)/ready
	$(VENV)/bin/python -m tests.benchmarks.table $(ONLY)

gallery: $(VENV)/ready
	$(VENV)/bin/python -m tests.tools.gallery $(RUNS)

$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; (3, 11) <= sys.version_info < (3, 14) or sys.exit("hugs needs Python 3.11 to 3.13, this is " + sys.version.split()[0] + "; name another: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[test,fleet,usd,sog]'
	touch $@

.PHONY: run test quick hard mutants lowest bench table gallery
