#!/usr/bin/env bash
# What a release must pass: the slow tests on the code as it is (tests/evidence.json); sdist and wheel build and describe themselves; the wheel, alone in a clean environment, gives the demo's answer;
# the tests of the sdist pass on its own installation.
# PYTHON: which interpreter. TESTS: which of the sdist's tests; "tests": all quick ones.
set -euo pipefail
cd "$(dirname "$0")/.."
: "${PYTHON:=python3}"
: "${TESTS:=tests/test_door.py tests/test_documents.py tests/test_planner_plan.py tests/test_planner_comparisons.py}"
"$PYTHON" tests/evidence.py --check
root=$PWD work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export XDG_CACHE_HOME=$work/cache

clean() {  # clean NAME REQUIREMENT...: an environment that holds nothing else
  "$PYTHON" -m venv "$work/$1"
  "$work/$1/bin/python" -m pip install --quiet --disable-pip-version-check -c "$root/constraints.txt" "${@:2}"
}

clean tools build twine
"$work/tools/bin/python" -m build --outdir "$work/dist" . > "$work/build.log" 2>&1 || { cat "$work/build.log"; exit 1; }
"$work/tools/bin/python" -m twine check --strict "$work"/dist/*

cd "$work"
SECONDS=0
clean wheel dist/*.whl
installed=$SECONDS
wheel/bin/mrac-jax evaluate example:terrain --rollouts 20000 --deadline 400 --no-advice --out demo > answer.txt
test -s demo/index.html
head -3 answer.txt
echo "wheel: installed in $installed s, $(du -sm wheel/lib | cut -f1) MB; the demo's answer, code compiled, $((SECONDS - installed)) s later"

tar -xf dist/*.tar.gz
clean sdist "$(echo dist/*.tar.gz)[dev]"
cd mrac_jax-*/
# shellcheck disable=SC2086  # TESTS is a list
"$work/sdist/bin/python" -m pytest -q -m "not slow" $TESTS
mkdir -p "$root/dist"
cp "$work"/dist/* "$root/dist/"
echo "dist/ holds what passed: $(cd "$work/dist" && echo *)"
