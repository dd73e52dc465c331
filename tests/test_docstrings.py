"""Every example in a docstring gives what it says."""

import doctest
import importlib
import pathlib

import pytest

import halfwidth

SOURCE = pathlib.Path(halfwidth.__file__).parent
NAMES = sorted(
    ".".join(("halfwidth", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__")
    for path in SOURCE.rglob("*.py")
    if ">>> " in path.read_text()
)


@pytest.mark.parametrize("name", NAMES)
def test_examples(name, capsys):
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted
    assert not found.failed, capsys.readouterr().out
