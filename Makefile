# Each target installs its requirements in .venv. Only Python 3.11 or newer must be installed before.
# ARGS is passed to the program: make demo ARGS=--help, make test ARGS='--only unit -- -k crc'
.POSIX:
.PHONY: help demo test test-all prove release soak hour bench conformance golden docs pictures wheels deb lint prose clean

help:
	@echo 'make demo      show the gateway at work without hardware   (ARGS=--help)'
	@echo 'make test      ruff, mypy, tests, and the most important tests on a real vcan'
	@echo '               (ARGS="--only lint|types|unit|vcan -- -k crc")'
	@echo 'make test-all  the slower tests: faults, systemd, browser, MQTT broker, CANopen masters'
	@echo '               of other projects   (ARGS="--only faults|tools|slow|masters|prove|cuts")'
	@echo 'make prove     the proofs of docs/proof.md that end within 5 min; a part of make test-all'
	@echo '               (your DBC: ARGS="-c /PATH/gateway.toml", see docs/your-own-dbc.md)'
	@echo 'make release   tests that take hours, on a quiet machine: faults on emulated hardware,'
	@echo '               random faults, a recorded hour'
	@echo '               (ARGS="--only qemu|outages|soak|hours|hour|put-in|machines|fuzz|years")'
	@echo '               (ARGS="--only proofs|eva|worst|plug|wheels|deb") (ARGS="--without deb")'
	@echo '               (ARGS="--only years -- --years 0.1")'
	@echo 'make soak      random faults for ten minutes   (ARGS="--minutes 60 --seed 1")'
	@echo 'make hour      convert a recorded hour to every format, read it back and compare'
	@echo '               (ARGS="--minutes 6")'
	@echo 'make bench     compare speed, delay and memory with a C program and a simple Python program'
	@echo '               (ARGS="--list" ARGS="--only cpu --seconds 10")'
	@echo 'make conformance  test the CANopen node against CiA 301, 305 and 306, and write the report'
	@echo '               (another slave: ARGS="--node 5 --eds x.eds --channel can0")'
	@echo 'make golden    record the golden set again and print the changes'
	@echo '               (ARGS="--check" ARGS="flights/v4")'
	@echo 'make docs      write docs/reference from the sources'
	@echo 'make pictures  draw docs/pictures: live screen and page, report  (ARGS=FOLDER: in all sizes)'
	@echo 'make wheels    build and check wheels with the core in C for x86-64, arm64 and armv7'
	@echo '               (ARGS=FOLDER)'
	@echo 'make deb       build Debian packages with all libraries for amd64, arm64 and armhf'
	@echo '               (ARGS=FOLDER)'
	@echo 'make lint      only ruff and mypy'
	@echo 'make prose     measure how plain the English is and how dense the code'
	@echo '               (ARGS="--worst 12" ARGS="--hits PATH")'
	@echo 'make clean     remove .venv and all caches'

demo:
	@tests/bootstrap.sh demo
	@.venv/bin/kontronik-can-gw demo $(ARGS)

test:
	@tests/bootstrap.sh test
	@.venv/bin/python tests/run.py test $(ARGS)

test-all:
	@tests/bootstrap.sh test-all
	@.venv/bin/python tests/run.py test-all $(ARGS)

prove:
	@tests/bootstrap.sh prove
	@case " $(ARGS) " in \
	*" -c "*) PYTHONPATH=tests .venv/bin/python tests/proofs/prove_dbc.py $(ARGS);; \
	*) .venv/bin/python tests/run.py prove $(ARGS);; \
	esac

release:
	@tests/bootstrap.sh release
	@.venv/bin/python tests/run.py release $(ARGS)

soak:
	@tests/bootstrap.sh release
	@.venv/bin/python tests/faults/programme.py soak $(ARGS)

hour:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/hour/hour_programme.py $(ARGS)

bench:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/benchmarks/bench.py $(ARGS)

conformance:
	@tests/bootstrap.sh test
	@if [ -n "$(ARGS)" ]; then \
		.venv/bin/kontronik-can-gw conformance $(ARGS); \
	else \
		mkdir -p build/conformance && \
		tests/vm/run --rw build/conformance -- \
			.venv/bin/python tests/vcan/conformance_report.py build/conformance && \
		cp build/conformance/conformance.md docs/reference/conformance.md; \
	fi

golden:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/golden/record.py $(ARGS)

docs:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/readme/reference.py

pictures:
	@tests/bootstrap.sh pictures
	@PYTHONPATH=tests/cli:tests/report:tests/live:tests/recordings:tests/capture .venv/bin/python tests/readme/pictures.py $(ARGS)

wheels:
	@tests/bootstrap.sh wheels
	@.venv/bin/python tests/native/wheels.py $(ARGS)

deb:
	@tests/bootstrap.sh wheels
	@.venv/bin/python deb/make_deb.py $(ARGS)

lint:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/run.py test --only lint --only types

prose:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/prose/plain_english.py $(ARGS)

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis tests/vm/.cache tests/foreign/.cache tests/deb/.cache build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
