"""Compilers and options with which the tests compile C."""

import shutil

import pytest

COMPILER = shutil.which("gcc") or shutil.which("clang") or ""
needs_compiler = pytest.mark.skipif(not COMPILER, reason="no C compiler: gcc or clang")
SANITIZED = [COMPILER, "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
FAST = [COMPILER, "-O2"]
