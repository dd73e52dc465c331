"""Jobs as plain data: what they hold, what they refuse, and that they give what the front door gives."""

import json
import tomllib

import numpy as np
import pytest
from tests.vehicle.drives import drive, save

import halfwidth as hw
from halfwidth.job import Job, linear, run
from halfwidth.shells import cli

MODEL = """
time = "when"
outputs = ["seen"]
inputs = ["push"]
states = ["place", "speed"]
dt = 0.5
A = [[1, 0.5], [0, 1]]
B = [[0.125], [0.5]]
C = [[1, 0]]
w = { gaussian = [1e-4, 1e-3] }
e = { gaussian = 0.04 }
x0 = { mean = [0, 0], covariance = [[1, 0], [0, 1]] }
"""


@pytest.fixture
def table(tmp_path):
    rng = np.random.default_rng(1)
    t = np.arange(80) * 0.5
    push = np.sin(t)
    seen = np.cumsum(np.cumsum(push) * 0.5) * 0.5 + 0.2 * rng.standard_normal(80)
    seen[30:40] = np.nan
    return {"when": t, "push": push, "seen": seen}


@pytest.fixture
def files(table, tmp_path):
    (tmp_path / "model.toml").write_text(MODEL)
    return str(tmp_path / "model.toml"), save(tmp_path / "data.csv", table, digits=17)


def spec(**changes):
    data = tomllib.loads(MODEL)
    for key, value in changes.items():
        if value is None:
            del data[key]
        else:
            data[key] = value
    return data


def test_it_is_what_the_front_door_gives(table, files):
    found = run(Job("estimate", files[1], model=spec()))
    model = hw.Linear(
        [[1, 0.5], [0, 1]], [[0.125], [0.5]], [[1, 0]], hw.Gaussian([1e-4, 1e-3]), hw.Gaussian(0.04),
        hw.Normal([0.0, 0.0], np.eye(2)), dt=0.5,
    )  # fmt: skip
    expected = hw.estimate(model, hw.Record(table["when"], table["seen"], table["push"]))
    np.testing.assert_array_equal(found.x, expected.x)
    assert found.names == ("place", "speed")


def test_a_job_is_plain_data_and_back(files):
    job = Job("estimate", files[1], model=spec(), method="KalmanFilter", level=0.5)
    assert Job.from_dict(json.loads(json.dumps(job.to_dict()))) == job
    with pytest.raises(hw.BadValue, match="unknown key `recrod`"):
        Job.from_dict({"task": "fill", "recrod": "x"})


def test_fill_through_a_job(tmp_path):
    log = save(tmp_path / "log.csv", drive(200, dt=0.2))
    track = run(Job("fill", log, method="linear", level=0.5, settings={"clock_offset": 0.1}))
    assert (track.method, track.level) == ("linear", 0.5)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"task": "nap"}, "`task` is 'nap'"),
        ({"task": "fill", "level": 1.0}, "a probability"),
        ({"task": "fill", "model": {}}, "takes no `model`"),
        ({"task": "estimate"}, "needs a `model`"),
    ],
)
def test_what_a_job_refuses(given, words):
    with pytest.raises(hw.BadValue, match=words):
        Job(**({"record": "x"} | given))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"A": None}, "the model has no key `A`\nhint: A = "),
        ({"outputs": None}, 'no key `outputs`\nhint: outputs = \\["position"\\]'),
        ({"B": None}, "has the key `inputs` but not `B`"),
        ({"inputs": None}, "has the key `B` but not `inputs`"),
        ({"A": [[1, 2], [3]]}, "the key `A` is .*a list of rows of numbers"),
        ({"A": 3}, "the key `A` is 3"),
        ({"A": [["a"]]}, "list of rows of numbers"),
        ({"C": [[1, 0, 0]]}, "`C`"),
        ({"w": 3}, "the key `w` is 3, a table with gaussian or uniform"),
        ({"w": {}}, "the key `w`: the table is empty"),
        ({"w": {"gausian": 1}}, "unknown key `gausian`.*\nhint: `gaussian`"),
        ({"w": {"uniform": -1.0}}, "the key `w`: .*half-width"),
        ({"w": {"uniform": 1.0, "at_most": 2.0}}, "one is expected"),
        ({"x0": {"mean": [0, 0]}}, "the key `x0`: it has mean"),
        ({"bounds": {"lo": [0, 0]}}, "the key `bounds`: it has lo"),
        ({"bounds": {"D": [[1, 0, 0]], "lo": 0}}, "`bounds` has a `D` of shape"),
        ({"bounds": {"D": [[1, 0]], "lo": "a"}}, "the key `bounds`: `lo` is 'a'"),
        ({"bounds": 3}, "the key `bounds` is 3"),
        ({"states": "place"}, "the key `states` is 'place', a list of names"),
        ({"dt": "fast"}, "the key `dt` is 'fast', a number"),
        ({"dT": 1}, "unknown key `dT`"),
    ],
)
def test_a_wrong_model_names_its_key(changes, words):
    with pytest.raises(hw.HalfwidthError, match=words):
        linear(spec(**changes))


def test_all_kinds_of_noise_and_priors():
    assert isinstance(linear(spec(w={"uniform": [0.1, 0.2]})).w, hw.Uniform)
    assert isinstance(linear(spec(w={"uniform": 0.1, "gaussian": 0.2})).w, hw.Mixed)
    assert not linear(spec(w={"gaussian": {"at_most": 4.0}})).w.known
    assert not linear(spec(w={"at_most": [1.0, 2.0]})).w.known
    assert isinstance(linear(spec(x0={"lo": [0, 0], "hi": [1, 1]})).x0, hw.Box)
    bounded = linear(spec(bounds={"lo": [-9, -9], "hi": [9, 9]}, E=[[1, 0.1], [0, 1]], x0=None))
    assert bounded.bounds is not None
    planes = linear(spec(bounds={"D": [[1, -1]], "lo": 0}))
    assert planes.bounds.contains(np.array([2.0, 1.0]))
    assert bounded.E is not None
    unknown = linear(spec(A=[[1, float("nan")], [0, 1]], theta_bounds={"lo": [0.1], "hi": [0.9]}))
    assert len(unknown.theta_entries) == 1


# --- the same through the command line -----------------------------------------------------------


@pytest.mark.parametrize("name", ["out.csv", "out.csv.gz", "out.parquet"])
def test_estimate_writes_states(name, files, table, tmp_path, capsys):
    import pandas

    out = tmp_path / name
    assert cli.run(["estimate", *files, "-o", str(out)]) == 0
    data, words = capsys.readouterr()
    assert data == ""
    assert f"wrote {out}" in words
    found = pandas.read_parquet(out) if name.endswith("parquet") else pandas.read_csv(out)
    assert list(found) == ["when", "place", "speed", "place_lo", "place_hi", "speed_lo", "speed_hi"]
    expected = run(Job("estimate", files[1], model=spec()))
    np.testing.assert_allclose(found["place"], expected.x[:, 0], rtol=1e-15)
    assert cli.run(["estimate", *files, "-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_estimate_to_standard_output_and_as_json(files, capsys):
    assert cli.run(["estimate", *files, "-q"]) == 0
    assert capsys.readouterr().out.startswith("when,place,speed,place_lo")
    assert cli.run(["estimate", *files, "--json", "-q", "--method", "KalmanFilter"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["schema_version"] == 1
    assert data["method"].startswith("KalmanFilter")
    assert len(data["x"]) == 80


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("A = [", 3, "is no TOML"),
        (MODEL.replace("A =", "AA ="), 3, "unknown key `AA`"),
        (MODEL.replace('"seen"', '"sean"'), 3, "has no column 'sean'; found: when, push, seen"),
        (MODEL + '\n[method]\nname = "KalmanFlter"\n', 3, "hint: KalmanFilter"),
        (MODEL + "\n[method]\nsteady = true\n", 3, "no `method` is named"),
        (MODEL + '\n[method]\nname = "KalmanFilter"\nsted = true\n', 3, "unknown key `sted`"),
        ("method = 'KalmanFilter'" + MODEL.replace("{ gaussian = 0.04 }", "{ uniform = 0.2 }"), 2, "Refused: "),
    ],
)
def test_estimate_says_what_is_wrong(text, code, words, files, tmp_path, capsys):
    (tmp_path / "wrong.toml").write_text(text)
    assert cli.run(["estimate", str(tmp_path / "wrong.toml"), files[1]]) == code
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("text", ["a,b,c\n1,2,3\n4,5,6\n", "lat\n1\n", "# nothing\n"])
def test_a_table_without_the_columns_of_the_model_is_not_taken_for_a_log(text, files, tmp_path, capsys):
    (tmp_path / "other.csv").write_text(text)
    assert cli.run(["estimate", files[0], str(tmp_path / "other.csv")]) == 3
    err = capsys.readouterr().err
    assert "has no column 'when'; found: " in err
    assert "hint: `time`, `outputs` and `inputs` of the model name the columns" in err
    assert "latitude" not in err


def test_a_model_that_is_not_there(files, capsys):
    assert cli.run(["estimate", "/no/such.toml", files[1]]) == 3
    assert "cannot be read: no such file or directory\nhint: check the spelling" in capsys.readouterr().err


def test_dates_become_seconds(files, table, tmp_path):
    when = [str(np.datetime64("2024-05-01") + np.timedelta64(round(1000 * s), "ms")) for s in table["when"]]
    found = run(Job("estimate", save(tmp_path / "dated.csv", table | {"when": when}, digits=17), model=spec()))
    expected = run(Job("estimate", files[1], model=spec()))
    np.testing.assert_allclose(found.x, expected.x, atol=1e-12)
