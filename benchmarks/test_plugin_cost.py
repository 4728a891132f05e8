"""What the plugin of pytest adds to a session without render tests.

Run with ``pytest benchmarks/test_plugin_cost.py --benchmark-only -s``: ten seconds. A failure: the
plugin loads a module of another package that pytest has not loaded itself.
"""

import os
import resource
import statistics
import subprocess
import sys

PLUGIN = "chdstat.render_tests.plugin"
ROUNDS = 9


def session(folder, *options):
    """Return the seconds of processor time that a session of one empty test takes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    given = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        *options,
        "test_one.py",
    ]
    alone = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    subprocess.run(given, cwd=folder, check=True, capture_output=True, env=alone)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_a_session_that_does_not_use_the_plugin(as_benchmark, tmp_path):
    """Pairs of sessions in turns, so that a busy machine slows both."""
    (tmp_path / "test_one.py").write_text("def test_one():\n    pass\n")
    plain, more = [], []
    for _ in range(ROUNDS):
        plain.append(session(tmp_path))
        more.append(session(tmp_path, "-p", PLUGIN) - plain[-1])
    print(
        f"\nwithout the plugin {statistics.median(plain):.3f} s; it adds "
        f"{statistics.median(more):+.3f} s ({min(more):+.3f} to {max(more):+.3f})"
    )


def test_modules_that_the_plugin_loads(as_benchmark):
    new = "print(*{*sys.modules} - old)"
    code = f"import sys, pytest\nold = {{*sys.modules}}\nimport {PLUGIN}\n{new}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    others = loaded - {*sys.stdlib_module_names} - {"chdstat"}
    print(f"\nmodules loaded: {len(done.stdout.split())}")
    assert not others
