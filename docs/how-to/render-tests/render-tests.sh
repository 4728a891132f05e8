#!/bin/sh
# Runs the render tests beside this script, in an environment of their own.
# Exit code: that of pytest, 0 if no light differs. Pages and JUnit XML: render-report/.
set -eu
cd "$(dirname "$0")"
if [ ! -d .venv ]; then
    python3 -m venv .venv
    .venv/bin/python -m pip install -r requirements-test.txt
fi
exec .venv/bin/python -m pytest --render-report render-report \
    --junitxml render-report/tests.xml "$@"
