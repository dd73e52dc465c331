"""Every guide is a script that runs, and says something."""

import pathlib
import runpy

import pytest

EXAMPLES = sorted((pathlib.Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out.strip()


def test_the_ten_lines_of_the_readme(capsys):
    text = (pathlib.Path(__file__).parents[1] / "README.md").read_text()
    exec(text.split("```python\n")[1].split("```")[0], {})
    out = capsys.readouterr().out
    assert "KalmanFilter" in out
    assert "KalmanSmoother" in out
