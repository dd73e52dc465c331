"""`halfwidth reproduce 001` runs and prints every table."""

from halfwidth.reproduce import paper001
from halfwidth.shells import cli


def test_tables_and_figures(monkeypatch, capsys, tmp_path):
    few = {
        "accuracy": {"runs": 3, "only": ("BKF-I", "GPB depth 1"), "depth": 3},
        "against_exact": {"runs": 2, "T": 6},
        "smoothing_against_exact": {"runs": 2, "T": 6, "depths": (1,)},
        "lags": {"runs": 2, "T": 20, "depth": 2},
        "learned": {"runs": 1, "T": 60},
    }
    for name, settings in few.items():
        whole = getattr(paper001, name)
        monkeypatch.setattr(paper001, name, lambda *a, whole=whole, s=settings, **k: whole(*a, **(k | s)))
    assert cli.run(["reproduce", "001", "--quick"]) == 0
    out = capsys.readouterr().out
    for words in ("losses known", "gate 99 %", "linear (Nahi)", "GPB depth 11", "lag 3", "stay received", "S4"):
        assert words in out
    assert all(file.exists() for file in paper001.figures(tmp_path, quick=True))
