# make demo: set up and identify the recording in examples/. make test: set up and run the tests.
# make decisions: names once more, optimized as users have them, with other machine instructions, which round
# differently.
# make lint, make docs, make benchmark. make paper: the paper's experiments, to out/paper; make paper-quick: a
# small part of them, in a minute or two.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DECISIONS := $(addprefix tests/test_,naming.py special_joints.py wiping.py)

.PHONY: demo test decisions lint benchmark paper paper-quick docs clean

# the stamp names the Python version, so that another interpreter makes a new environment
STAMP := $(VENV)/.installed-$(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')

demo: $(STAMP)
	@mkdir -p out
	$(BIN)/reframe-jax identify examples/pin_on_plane.csv --plot out/pin_on_plane.png --json out/pin_on_plane.json

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

decisions: $(STAMP)
	XLA_FLAGS=--xla_cpu_max_isa=SSE4_2 OPENBLAS_CORETYPE=Nehalem \
	  $(BIN)/python -m pytest -n 2 --dist loadfile $(DECISIONS)

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest --quiet -n 0 tests/test_names.py

benchmark: $(STAMP)
	$(BIN)/python -m benchmarks.identification --quick --gate

paper: $(STAMP)
	$(BIN)/python -m benchmarks.paper

paper-quick: $(STAMP)
	$(BIN)/python -m benchmarks.paper --quick --fresh --out out/paper-quick

docs: $(STAMP)
	$(BIN)/python -m sphinx -E -W --keep-going -q -b html docs docs/_build/html
	@echo docs/_build/html/index.html

$(STAMP): pyproject.toml requirements.txt
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Python 3.11 or newer is needed; set PYTHON="'
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes --requirement requirements.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

clean:
	rm -rf $(VENV) .jax_cache out docs/_build
