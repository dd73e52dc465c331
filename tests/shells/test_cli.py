"""The command line keeps its word: where data and words go, exit codes, and what is never overwritten."""

import contextlib
import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tests.vehicle.drives import drive, save

import halfwidth as hw
from halfwidth.shells import cli, say

GOOD, INTERNAL, USAGE, BAD, NO_ESTIMATE, LIMIT = 0, 1, 2, 3, 4, 6


@pytest.fixture
def log(tmp_path):
    """A minute of driving at 5 Hz with a tunnel of eight seconds."""
    columns = drive(300, dt=0.2)
    dark = (columns["t_s"] > 20) & (columns["t_s"] < 28)
    for name in ("lat_deg", "lon_deg", "alt_m", "azimuth_rad"):
        columns[name] = np.where(dark, np.nan, columns[name])
    return save(tmp_path / "log.csv", columns)


def process(*args, **how):
    return subprocess.Popen([sys.executable, "-m", "halfwidth", *args], **how)


def done(*args, **how):
    return subprocess.run([sys.executable, "-m", "halfwidth", *args], capture_output=True, check=False, **how)


# --- help ---------------------------------------------------------------------------------------


def test_help_names_every_command_and_the_exit_codes(capsys):
    assert cli.run(["--help"]) == GOOD
    out, err = capsys.readouterr()
    for name in ("fill", "check", "outages", "demo", "estimate", "doctor", "--version", "Exit codes: 0 good"):
        assert name in out
    assert err == ""


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        ("fill", "--output -o --report --method --level --clock-offset --json --dry-run --force --quiet --verbose "
                 "-v --no-progress --columns --format"),
        ("check", "--json --columns"),
        ("outages", "--lengths --starts --seed --methods --clock-offset --plot --json --columns"),
        ("demo", "--output --seed --json --force"),
        ("estimate", "--output --method --level --seed --json --force"),
        ("doctor", "--json"),
    ],
)  # fmt: skip
def test_help_of_each_command(command, flags, capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert cli.run([command, "--help"]) == GOOD
    out = capsys.readouterr().out
    for flag in flags.split():
        assert flag in out
    assert "\x1b" not in out


def test_version(capsys):
    assert cli.run(["--version"]) == GOOD
    assert capsys.readouterr().out == f"halfwidth {hw.__version__}\n"


def test_help_loads_nothing_heavy():
    code = (
        "import sys\nfrom halfwidth.shells.cli import run\nrun(['--help'])\n"
        "print([m for m in ('numpy', 'scipy', 'pandas', 'pyarrow', 'rich', 'narwhals') if m in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines()[-1] == "[]"


def test_completion():
    env = os.environ | {"_HALFWIDTH_COMPLETE": "complete_bash", "COMP_WORDS": "halfwidth ch", "COMP_CWORD": "1"}
    assert done(env=env).stdout.split() == [b"check"]


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ([], ""),
        (["chekc"], "Did you mean 'check'?"),
        (["check"], "LOG"),
        (["check", "--jsn", "x"], "--json"),
        (["outages", "x", "--starts", "0"], "'0'"),
        (["outages", "x", "--starts=-3"], "'-3'"),
        (["outages", "x", "--seed", "one"], "hint: halfwidth outages drive.csv --lengths 1,5,30"),
        (["fill"], "hint: halfwidth fill drive.csv -o drive.gpx"),
        (["fill", "x", "-o", "a.csv", "--guaranteed", "4"], "hint: halfwidth fill drive.csv -o drive.gpx"),
        (["fill", "x", "-o", "a.csv", "--limits", "speed"], "`--limits` is 'speed': "),
        (["outages", "x", "--plot", "o.doc"], "`--plot` is 'o.doc', a name ending in .png, .svg or .pdf"),
        (["outages", "x", "--lengths", "one"], "`--lengths` is 'one', positive numbers"),
        (["outages", "x", "--lengths", "1,-2"], "positive numbers"),
        (["outages", "x", "--methods", "nope"], "there is no method 'nope', one of"),
        (["fill", "x"], "hint: -o OUT, or -o - for standard output"),
        (["fill", "x", "-o", "out.csv", "--level", "2"], "`--level` is 2, a probability"),
        (["fill", "x", "-o", "out.csv", "--level", "nan"], "a probability"),
        (["fill", "x", "-o", "out.csv", "--clock-offset", "inf"], "finite number of seconds"),
        (["fill", "x", "-o", "out.csv", "--method", "linaer"], "hint: linear"),
        (["fill", "x", "-o", "out.doc"], "hint: -o track.gpx, or --format gpx"),
        (["fill", "x", "-o", "-", "--format", "doc"], "`--format` is 'doc', one of .csv, "),
        (["fill", "x", "-o", "-", "--json"], "both claim standard output"),
        (["fill", "x", "-o", "-", "--report", "-"], "both claim standard output"),
        (["fill", "x", "-o", "no/such/folder/out.csv"], "hint: mkdir -p no/such/folder"),
        (["estimate", "m.toml", "x", "-o", "out.gpx"], ".csv, .csv.gz or .parquet is expected"),
        (["estimate", "m.toml", "x", "--level", "0"], "a probability"),
        (["estimate", "-", "-"], "both claim standard input"),
        (["estimate", "m.toml", "x", "--method", "KalmanFiltr"], "hint: KalmanFilter"),
    ],
)
def test_usage(args, words, capsys):
    assert cli.run(args) == USAGE
    out, err = capsys.readouterr()
    assert words in err
    assert out == "" or not args


def test_without_typer_it_says_how_to_get_it():
    code = "import sys; sys.modules['typer'] = None; from halfwidth.shells.cli import main; main(['--help'])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == USAGE
    assert "pip install 'halfwidth[app]'" in found.stderr


# --- fill ---------------------------------------------------------------------------------------


def test_fill_writes_a_track_and_a_report_and_words_to_standard_error(log, tmp_path, capfd):
    out, page = tmp_path / "out.csv", tmp_path / "out.html"
    assert cli.run(["fill", log, "-o", str(out), "--report", str(page)]) == GOOD
    data, words = capfd.readouterr()
    assert data == ""
    assert f"wrote {out}" in words
    with open(out) as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 300
    assert {row["quality"] for row in rows} == {"fix", "bridged"}
    assert "</html>" in page.read_text()
    assert "halfwidth " in page.read_text()


def test_fill_to_standard_output_is_the_same_as_to_a_file(log, tmp_path, capfdbinary):
    assert cli.run(["fill", log, "-o", str(tmp_path / "out.csv"), "--quiet"]) == GOOD
    assert capfdbinary.readouterr() == (b"", b"")
    assert cli.run(["fill", log, "-o", "-", "--quiet"]) == GOOD
    out, err = capfdbinary.readouterr()
    assert out == (tmp_path / "out.csv").read_bytes()
    assert err == b""


def test_fill_from_standard_input(log, tmp_path):
    with open(log, "rb") as file:
        found = done("fill", "-", "-o", "-", "--format", "geojson", stdin=file)
    assert found.returncode == GOOD, found.stderr
    assert json.loads(found.stdout)["type"] == "FeatureCollection"


def test_fill_as_json(log, tmp_path, capsys):
    out = tmp_path / "out.gpx"
    assert cli.run(["fill", log, "-o", str(out), "--json", "--method", "linear", "--level", "0.5"]) == GOOD
    data = json.loads(capsys.readouterr().out)
    assert data["schema_version"] == 1
    assert data["method"] == "linear"
    assert data["level"] == 0.5
    assert data["rows"]["bridged"] > 30
    assert data["gaps"][0]["stop"] == pytest.approx(28, abs=0.3)
    assert data["written"] == {"track": str(out), "report": None}
    assert out.exists()


def test_columns_can_be_named(log, tmp_path, capsys):
    text = Path(log).read_text().replace("lat_deg", "a").replace("lon_deg", "b")
    (tmp_path / "odd.csv").write_text(text)
    assert cli.run(["fill", str(tmp_path / "odd.csv"), "--json", "--columns", "lat=a,lon=b", "-q"]) == GOOD
    assert json.loads(capsys.readouterr().out)["log"]["fixes"] > 200
    assert cli.run(["fill", str(tmp_path / "odd.csv"), "--json", "--columns", "lat"]) == BAD


def test_repairs_are_told(log, tmp_path, capsys):
    columns = drive(300, dt=0.2)
    columns["speed_mps"] = columns["speed_mps"] * 3.6
    path = save(tmp_path / "kmh.csv", columns)
    assert cli.run(["fill", path, "-o", str(tmp_path / "out.csv")]) == GOOD
    assert "note: speed is in km/h" in capsys.readouterr().err


def test_a_dry_run_writes_nothing(log, tmp_path, capsys):
    assert cli.run(["fill", log, "-o", str(tmp_path / "out.csv"), "--dry-run", "--json"]) == GOOD
    data = json.loads(capsys.readouterr().out)
    assert data["would_write"] == [str(tmp_path / "out.csv")]
    assert not (tmp_path / "out.csv").exists()


# --- what is never overwritten ------------------------------------------------------------------


def test_an_existing_file_is_kept_unless_forced(log, tmp_path, capsys):
    out = tmp_path / "out.csv"
    out.write_text("old")
    assert cli.run(["fill", log, "-o", str(out)]) == USAGE
    assert "exists already\nhint: --force overwrites it" in capsys.readouterr().err
    assert out.read_text() == "old"
    assert cli.run(["fill", log, "-o", str(tmp_path / "new.csv"), "--report", str(out)]) == USAGE
    assert not (tmp_path / "new.csv").exists()
    assert cli.run(["fill", log, "-o", str(out), "--force"]) == GOOD
    assert out.read_text().startswith("t_s,")


def test_the_input_is_never_overwritten(log, tmp_path, capsys):
    before = Path(log).read_text()
    (tmp_path / "link.csv").symlink_to(log)
    for name in (log, str(tmp_path / "link.csv")):
        assert cli.run(["fill", log, "-o", name, "--force"]) == USAGE
        assert "is the input itself" in capsys.readouterr().err
    assert Path(log).read_text() == before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("", "is a directory"),
        ("log.csv/out.csv", "is no folder"),
        ("nowhere/out.csv", "is no folder"),
        ("x" * 300 + ".csv", "file name too long"),
    ],
)
def test_a_place_that_cannot_be_written(name, words, log, tmp_path, capsys):
    assert cli.run(["fill", log, "-o", str(tmp_path / name) if name else str(tmp_path)]) == USAGE
    assert words in capsys.readouterr().err


def test_a_folder_that_is_not_ours_is_told_before_any_work(log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr("halfwidth.job.run", None)
    assert cli.run(["fill", log, "-o", str(tmp_path / "out.csv")]) == USAGE
    assert f"`{tmp_path}` takes no files from you" in capsys.readouterr().err


def test_a_figure_without_matplotlib_is_told_before_any_work(log, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert cli.run(["outages", log, "--plot", "o.png"]) == USAGE
    assert "hint: pip install 'halfwidth[plot]'" in capsys.readouterr().err


def test_the_short_help_is_not_cut(capsys):
    assert cli.run(["-h"]) == GOOD
    assert "..." not in capsys.readouterr().out.partition("Commands:")[2]


def test_a_folder_that_takes_no_files(log, capsys):
    assert cli.run(["fill", log, "-o", "/proc/out.csv"]) == USAGE
    assert "`/proc/out.csv` cannot be written" in capsys.readouterr().err


# --- a full disk, a reader that leaves, signals ---------------------------------------------------


FULL = """
import resource, sys
from halfwidth.shells.cli import run
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
sys.exit(run(sys.argv[1:]))
"""


@pytest.mark.parametrize("name", ["out.csv", "out.gpx", "out.parquet"])
def test_a_full_disk_leaves_the_old_file(name, log, tmp_path):
    out = tmp_path / name
    out.write_text("old")
    found = subprocess.run(
        [sys.executable, "-c", FULL, "fill", log, "-o", str(out), "--force"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == LIMIT, found.stderr
    assert f"`{out}` cannot be written: file too large; what was there before is still there" in found.stderr
    assert out.read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["log.csv", name])


@pytest.mark.parametrize("args", [["check"], ["check", "--json"], ["fill", "-o", "-"], ["fill", "--json"]])
def test_a_standard_output_that_is_full(args, log):
    with open("/dev/full", "wb") as full:
        found = subprocess.run(
            [sys.executable, "-m", "halfwidth", args[0], log, *args[1:]],
            stdout=full,
            stderr=subprocess.PIPE,
            check=False,
        )
    assert found.returncode == LIMIT
    assert b"no space left on device" in found.stderr
    assert b"Traceback" not in found.stderr
    assert b"Exception ignored" not in found.stderr


def test_a_device_that_is_full(log, capsys):
    assert cli.run(["fill", log, "-o", "/dev/full", "--format", "csv", "--force"]) == LIMIT
    assert "`/dev/full` cannot be written: no space left on device" in capsys.readouterr().err


@pytest.mark.parametrize("args", [["check"], ["fill", "-o", "-", "-q"]])
def test_a_reader_that_leaves_is_no_failure(args, log):
    running = process(args[0], log, *args[1:], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    running.stdout.close()
    err = running.stderr.read()
    running.stderr.close()
    assert running.wait() == GOOD
    assert b"Traceback" not in err
    assert b"Broken" not in err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals(number, code):
    running = process("check", "-", stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    # more than a pipe holds: once it is written, the program is reading
    running.stdin.write(b"t_s,lat_deg,lon_deg\n" + b"0,1,1\n" * 50_000)
    running.stdin.flush()
    running.send_signal(number)
    out, err = running.communicate()
    assert running.returncode == code
    assert out == b""
    assert b"Traceback" not in err


# --- internal errors ----------------------------------------------------------------------------


def test_an_internal_error_is_one_line_and_a_hint(log, monkeypatch, capsys):
    def broken(*_args, **_how):
        raise ZeroDivisionError("not our day")

    monkeypatch.setattr("halfwidth.job.run", broken)
    assert cli.run(["fill", log, "--json"]) == INTERNAL
    err = capsys.readouterr().err
    assert err == "internal error: ZeroDivisionError: not our day\nhint: -v shows where, please report it\n"
    assert cli.run(["fill", log, "--json", "-v"]) == INTERNAL
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (hw.Unsolved("Status.INFEASIBLE: no trajectory fits the bounds"), NO_ESTIMATE),
        (hw.Refused("this method cannot"), USAGE),
        (hw.Missing("not installed"), USAGE),
        (hw.LogTooBig("too big"), LIMIT),
        (hw.BadRecord("bad"), BAD),
        (MemoryError(), LIMIT),
        (KeyboardInterrupt(), 130),
    ],
)
def test_exit_codes_of_errors(error, code, log, monkeypatch, capsys):
    def broken(_job):
        raise error

    monkeypatch.setattr("halfwidth.job.run", broken)
    assert cli.run(["fill", log, "--json"]) == code
    assert "Traceback" not in capsys.readouterr().err


# --- check, outages, demo, doctor ----------------------------------------------------------------


def test_check_speaks_to_standard_output(log, capsys):
    assert cli.run(["check", log]) == GOOD
    out, err = capsys.readouterr()
    assert out.startswith(f"{log}: ")
    assert err == ""
    assert cli.run(["check", log, "--json"]) == GOOD
    data = json.loads(capsys.readouterr().out)
    assert (data["schema_version"], data["command"]) == (1, "check")


def test_check_word_for_word(tmp_path, capsys, monkeypatch):
    columns = drive(600)
    braking = np.pad(columns["speed_mps"], 10, mode="edge")  # for a second: at once is a fault
    columns["speed_mps"] = np.round(np.convolve(braking, np.full(21, 3.6 / 21), "valid"))
    save(tmp_path / "log.csv", columns)
    monkeypatch.chdir(tmp_path)
    assert cli.run(["check", "log.csv"]) == GOOD
    assert capsys.readouterr().out == (Path(__file__).parent / "golden" / "check.txt").read_text()


def test_outages(log, capsys):
    args = ["outages", log, "--lengths", "1,2", "--starts", "2", "--methods", "linear,em"]
    assert cli.run(args) == GOOD
    out, err = capsys.readouterr()
    assert "linear" in out
    assert err == ""
    assert cli.run([*args, "--json"]) == GOOD
    data = json.loads(capsys.readouterr().out)
    assert data["schema_version"] == 1
    assert {cell["method"] for cell in data["cells"]} == {"linear", "em"}
    assert data["longest_within_s"].keys() == {"linear", "em"}


def test_outages_plotted(log, tmp_path, capsys):
    pytest.importorskip("matplotlib").use("Agg")
    args = ["outages", log, "--lengths", "1", "--starts", "2", "--methods", "linear", "--plot", str(tmp_path / "o.svg")]
    assert cli.run(args) == GOOD
    assert "<svg" in (tmp_path / "o.svg").read_text()
    assert cli.run(args) != GOOD  # it is there already
    assert "--force" in capsys.readouterr().err
    assert cli.run([*args, "--force"]) == GOOD


def test_demo(tmp_path, capsys):
    folder = tmp_path / "demo"
    assert cli.run(["demo", "-o", str(folder), "--json"]) == GOOD
    data = json.loads(capsys.readouterr().out)
    assert len(data["tunnels"]) == 3
    assert os.path.exists(data["report"])
    assert cli.run(["demo", "-o", str(folder), "-q"]) == GOOD  # the same again
    capsys.readouterr()
    (folder / "track.gpx").rename(folder / "mine.gpx")
    assert cli.run(["demo", "-o", str(folder)]) == USAGE
    assert "holds other files already" in capsys.readouterr().err


def test_doctor(capsys):
    assert cli.run(["doctor", "--json"]) == GOOD
    data = json.loads(capsys.readouterr().out)
    assert data["self_test"] == {"core": "good", "highs": "good", "piqp": "good"}
    assert data["core"]["instructions"] in ("avx2", "base")
    assert cli.run(["doctor"]) == GOOD
    assert capsys.readouterr().out.startswith(f"halfwidth {hw.__version__}: all good\n")


def test_progress_shows_on_a_terminal_only(monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    with say.working("filling", quiet=False) as progress:
        assert progress is None
    shown.isatty = lambda: True
    with say.working("filling", quiet=True) as progress:
        assert progress is None
    assert shown.getvalue() == ""
    monkeypatch.setenv("TERM", "xterm")
    with say.working("filling", quiet=False) as progress:
        progress(0.25, "em, 1 s")
        deadline = time.monotonic() + 5
        while "25 %" not in shown.getvalue() and time.monotonic() < deadline:
            time.sleep(0.05)
    assert "\rfilling 25 %, em, 1 s, " in shown.getvalue()
    # what was shown is wiped away
    assert shown.getvalue().endswith("\r")


def test_a_file_name_cannot_steer_the_terminal(tmp_path, capsys):
    path = save(tmp_path / "a\x1b[31m.csv", drive(100))
    assert cli.run(["check", path]) == GOOD
    assert "\x1b" not in capsys.readouterr().out


def test_closed_standard_error_is_no_failure(log):
    with contextlib.suppress(FileNotFoundError):
        found = subprocess.run(
            [sys.executable, "-m", "halfwidth", "check", log], stdout=subprocess.PIPE, check=False,
            preexec_fn=lambda: os.close(2),
        )  # fmt: skip
        assert found.returncode == GOOD
        assert found.stdout


def test_closed_standard_output_is_no_failure(log):
    found = subprocess.run(
        [sys.executable, "-m", "halfwidth", "check", log], stderr=subprocess.PIPE, check=False,
        preexec_fn=lambda: os.close(1),
    )  # fmt: skip
    assert (found.returncode, found.stderr) == (GOOD, b"")


@pytest.mark.parametrize(
    ("args", "hint"),
    [
        (["fill", "LOG", "-o"], "-o FOLDER/track.csv"),
        (["fill", "LOG", "--report"], "--report FOLDER/drive.html"),
        (["check", "LOG", "--report"], "--report FOLDER/check.html"),
        (["estimate", "m.toml", "LOG", "-o"], "is a directory"),
    ],
)
def test_a_folder_in_place_of_a_file_is_answered_with_the_flag_that_was_given(args, hint, log, tmp_path, capsys):
    folder = tmp_path / "folder.csv"
    folder.mkdir()
    assert cli.run([str(log) if arg == "LOG" else arg for arg in args] + [str(folder)]) == USAGE
    assert hint.replace("FOLDER", str(folder)) in capsys.readouterr().err


def test_track_and_report_need_two_files(log, tmp_path, capsys):
    assert cli.run(["fill", str(log), "-o", str(tmp_path / "a.csv"), "--report", f"{tmp_path}/./a.csv"]) == USAGE
    assert "both claim" in capsys.readouterr().err
    assert not (tmp_path / "a.csv").exists()


def test_a_state_called_like_the_time_is_refused(tmp_path, capsys):
    (tmp_path / "m.toml").write_text(
        'outputs = ["y"]\nstates = ["t"]\nA = [[1]]\nC = [[1]]\nw = { gaussian = 1.0 }\ne = { gaussian = 1.0 }\n'
        "x0 = { mean = [0], covariance = [[1]] }\n"
    )
    (tmp_path / "d.csv").write_text("t,y\n0,1\n1,2\n")
    assert cli.run(["estimate", str(tmp_path / "m.toml"), str(tmp_path / "d.csv")]) == BAD
    out, err = capsys.readouterr()
    assert out == ""
    assert "a state is called 't'" in err


def test_fill_on_a_map_within_limits(log, tmp_path):
    with open(log, encoding="utf-8") as file:
        fixes = [(float(row["lon_deg"]), float(row["lat_deg"])) for row in csv.DictReader(file) if row["lat_deg"]]
    (tmp_path / "roads.geojson").write_text(json.dumps({"type": "LineString", "coordinates": fixes}))
    given = ["fill", str(log), "-o", str(tmp_path / "track.csv"), "--map", str(tmp_path / "roads.geojson")]
    found = done(*given, "--limits", "speed=-1:40,yaw_rate=1", "--json")
    assert found.returncode == GOOD, found.stderr
    assert json.loads(found.stdout)["method"] == "paper002"
    wrong = done("fill", str(log), "-o", str(tmp_path / "other.csv"), "--limits", "speed")
    assert wrong.returncode == USAGE
    assert b"NAME=SIZE" in wrong.stderr
    assert done(*given, "--force", "--method", "em").returncode == BAD
