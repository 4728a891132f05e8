from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from chdstat.errors import RenderError
from chdstat.rendering import backend
from chdstat.rendering.backend import TriedBackend, activate, llvm_libraries, probe, resolve

LIBRARY = "/nowhere/libLLVM.so.99"


@pytest.fixture
def no_cache(tmp_path, monkeypatch):
    """Start with an empty cache and one pretended LLVM library; return the cache's folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", LIBRARY)
    return tmp_path / "chdstat"


@pytest.fixture
def child(monkeypatch):
    """Replace what the child process runs."""

    def use(code: str) -> None:
        monkeypatch.setattr(backend, "_CHILD", code)

    return use


def test_scalar_needs_no_trial(no_cache, child):
    child("raise SystemExit(1)")
    assert probe("scalar").works
    assert resolve("scalar").name == "scalar"
    assert not no_cache.exists()


def test_answers_are_cached_until_asked_afresh(no_cache, child, monkeypatch):
    child("pass")
    first = probe("llvm")
    assert first == TriedBackend("llvm", works=True, detail="rendered an image", library=LIBRARY)
    assert len(list(no_cache.iterdir())) == 1
    child("raise SystemExit('broken since')")
    assert probe("llvm") == first
    assert not probe("llvm", fresh=True).works
    assert not probe("llvm").works
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM.so.15")
    child("pass")
    assert probe("llvm").works, "another library is tried anew"


@pytest.mark.parametrize(
    ("code", "seconds", "detail"),
    [
        (
            "import os, sys; print('LLVM ERROR: Cannot select', file=sys.stderr); os.abort()",
            600,
            "aborted by signal 6 (LLVM ERROR: Cannot select)",
        ),
        ("raise ImportError('no libLLVM')", 600, "raised (ImportError: no libLLVM)"),
        ("import time; time.sleep(600)", 1, "no image in 1 s"),
    ],
)
def test_a_child_that_draws_no_image_is_told(no_cache, child, monkeypatch, code, seconds, detail):
    monkeypatch.setattr(backend, "_TIMEOUT", seconds)
    child(code)
    assert detail in probe("llvm").detail
    with pytest.raises(RenderError, match="llvm .*scalar or auto"):
        resolve("llvm")
    assert resolve("auto").name == "scalar"


def test_the_child_gets_the_library_and_the_variant(no_cache, child):
    child(
        "import os, sys\n"
        f"assert os.environ['DRJIT_LIBLLVM_PATH'] == {LIBRARY!r}\n"
        "assert sys.argv[1] == 'llvm_ad_rgb'"
    )
    assert probe("llvm").works


def test_a_broken_cache_only_costs_the_trial(no_cache, child, monkeypatch):
    child("pass")
    assert probe("llvm").works
    (file,) = no_cache.iterdir()
    file.write_bytes(b"{")
    assert probe("llvm").works
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))  # where nothing can be written
    assert probe("llvm").works


def test_without_a_library_there_is_no_llvm(no_cache, monkeypatch):
    monkeypatch.setattr(backend, "llvm_libraries", list)
    assert probe("llvm") == TriedBackend("llvm", works=False, detail="no LLVM library found")


def test_the_newest_library_that_works_is_taken(no_cache, child, monkeypatch):
    libraries = [f"/nowhere/libLLVM.so.{version}" for version in (20, 19, 14)]
    monkeypatch.setattr(backend, "llvm_libraries", lambda: libraries)
    child("import os; assert not os.environ['DRJIT_LIBLLVM_PATH'].endswith('20')")
    assert probe("llvm").library == libraries[1]


def test_libraries_are_found_newest_first(tmp_path, monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    folder = tmp_path / "lib"
    folder.mkdir()
    for name in ("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVMExtra.so", "libLLVM.so.9"):
        (folder / name).write_text("")
    (folder / "libLLVM-19.so").symlink_to(folder / "libLLVM.so.19.1")
    monkeypatch.setattr(backend, "_LIBRARY_FOLDERS", (str(folder),))
    assert [Path(p).name for p in llvm_libraries()] == [
        "libLLVM.so.19.1",
        "libLLVM-14.so.1",
        "libLLVM.so.9",
    ]
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", LIBRARY)
    assert llvm_libraries() == [LIBRARY]


def test_activating_restores_the_variant():
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant("scalar_spectral")
    try:
        with activate(probe("scalar")) as active:
            assert active.variant() == "scalar_rgb"
        assert mi.variant() == "scalar_spectral"
        with pytest.raises(ZeroDivisionError), activate(probe("scalar")):
            raise ZeroDivisionError
        assert mi.variant() == "scalar_spectral"
    finally:
        mi.set_variant(before or "scalar_rgb")


def test_activating_heeds_the_user(monkeypatch):
    tried = replace(probe("scalar"), library=LIBRARY)
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/my/own.so")
    with activate(tried):
        assert os.environ["DRJIT_LIBLLVM_PATH"] == "/my/own.so"
