"""Every kind of bad log: what the command line says and the code it ends with, in one table."""

import contextlib
import gzip
import io
import random
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from tests.vehicle.drives import drive, save, text

from halfwidth.shells import cli

GOOD, USAGE, BAD, LIMIT = 0, 2, 3, 6


def put(content, name="log.csv"):
    """Write bytes, text or columns to a file."""

    def make(folder):
        path = folder / name
        if isinstance(content, dict):
            return save(path, content)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return str(path)

    return make


def changed(**changes):
    """Write a drive with some columns changed by functions of the column."""

    def make(folder):
        columns = drive()
        for name, change in changes.items():
            columns[name] = change(columns[name].copy())
        return save(folder / "log.csv", columns)

    return make


def at(rows, value):
    """Change the rows of a column to a value, which may be text."""

    def change(column):
        cells = list(column)
        for row in rows:
            cells[row] = value
        return cells

    return change


def renamed(**names):
    def make(folder):
        columns = {names.get(name, name): values for name, values in drive().items()}
        return save(folder / "log.csv", columns)

    return make


def rows(order):
    """Write a drive with its rows in another order."""

    def make(folder):
        columns = drive()
        index = order(np.arange(1200))
        return save(folder / "log.csv", {name: values[index] for name, values in columns.items()})

    return make


def late_restart(folder):
    """A second drive on the same clock behind the first."""
    one, other = drive(), drive(seed=2)
    both = {name: np.concatenate((one[name][:900], other[name][100:900])) for name in one}
    return save(folder / "log.csv", both)


def written_twice(index):
    """A part of the drive appended again."""
    return np.concatenate((index[:900], index[100:900]))


def swapped(folder):
    columns = drive()
    columns["lat_deg"], columns["lon_deg"] = columns["lon_deg"], columns["lat_deg"]
    return save(folder / "log.csv", columns)


def swapped_beyond(folder):
    columns = drive(lat0=40.0, lon0=-105.0)
    columns["lat_deg"], columns["lon_deg"] = columns["lon_deg"], columns["lat_deg"]
    return save(folder / "log.csv", columns)


def held(folder):
    columns = drive(every=10)
    for name in ("lat_deg", "lon_deg"):
        columns[name] = np.repeat(columns[name][::10], 10)
    return save(folder / "log.csv", columns)


def parquet(change=lambda raw: raw, n_columns=0):
    def make(folder):
        import pyarrow
        from pyarrow import parquet as pq

        columns = drive() if not n_columns else {f"c{k}": [1.0] for k in range(n_columns)}
        out = io.BytesIO()
        pq.write_table(pyarrow.table(columns), out)
        path = folder / "log.parquet"
        path.write_bytes(change(out.getvalue()))
        return str(path)

    return make


def scribble(raw):
    """Overwrite the first data pages."""
    noise = random.Random(1).randbytes(2000)
    return raw[:40] + noise + raw[2040:]


def gz(raw, change=lambda packed: packed):
    def make(folder):
        path = folder / "log.csv.gz"
        content = raw() if callable(raw) else raw
        path.write_bytes(change(gzip.compress(content, compresslevel=6, mtime=0)))
        return str(path)

    return make


def plain():
    return text(drive()).encode()


def bomb():
    return b"t_s,lat_deg,lon_deg\n" + b"0,0,0\n" * 1_000_000


def twice(folder):
    path = folder / "log.csv.gz"
    path.write_bytes(gzip.compress(gzip.compress(plain())))
    return str(path)


def folder_itself(folder):
    return str(folder)


def under_a_file(folder):
    path = folder / "file"
    path.write_text("x")
    return str(path / "log.csv")


def endless_link(folder):
    path = folder / "loop.csv"
    path.symlink_to(path)
    return str(path)


HEAD = "t_s,lat_deg,lon_deg,speed_mps\n"
ROWS = "".join(f"{k},{52 + k * 1e-4:.4f},{13 + k * 1e-4:.4f},13\n" for k in range(40))

#: name, what makes the file, exit code, words of the message
CASES = [
    ("empty", put(""), BAD, "is empty, a header and at least two fixes are expected"),
    ("only blank lines", put("\n\n  \n"), BAD, "is empty"),
    ("byte order mark only", put(b"\xef\xbb\xbf"), BAD, "is empty"),
    ("header only", put(HEAD), BAD, "has a header but no rows"),
    ("comments only", put("# a\n# b\n"), BAD, "has no column that is read as time, latitude, longitude"),
    ("no header", put(ROWS), BAD, "has no header line (the first line is numbers)"),
    ("one word", put("hello\n"), BAD, "found: hello; needed: time, latitude, longitude"),
    ("unknown columns", put("a,b,c\n1,2,3\n"), BAD, "found: a, b, c; needed: time, latitude, longitude"),
    ("unknown time", renamed(t_s="klok"), BAD, "--columns time=NAME"),
    ("unknown longitude", renamed(lon_deg="bla"), BAD, "no column that is read as longitude; found: t_s, lat_deg"),
    ("no fix", put(HEAD + "".join(f"{k},,,13\n" for k in range(40))), BAD, "40 rows and no row has a position"),
    ("one fix", put(HEAD + "0,52,13,1\n1,,,1\n"), BAD, "only one row has a position"),
    ("all fixes at zero", put(HEAD + "".join(f"{k},0,0,13\n" for k in range(9))), BAD, "none is on Earth"),
    ("latitude 999 throughout", changed(lat_deg=lambda v: v * 0 + 999), BAD, "none is on Earth (latitude 999 to 999"),
    ("latitude 999 once", changed(lat_deg=at([5], 999)), GOOD, "1 fix off the Earth dropped (the first: latitude 999"),
    ("zero fixes", changed(lat_deg=at([5, 6], 0), lon_deg=at([5, 6], 0)), GOOD, "2 fixes at latitude 0, longitude 0"),
    ("text for all latitudes", changed(lat_deg=lambda v: ["north"] * 1200), BAD, "holds text in 1200 of 1200 rows"),
    ("text for all times", changed(t_s=lambda v: ["noon"] * 1200), BAD, "times are expected"),
    ("text in numbers", changed(speed_mps=at([7, 8, 9], "fast")), GOOD, "3 cells of `speed_mps` are text"),
    ("nan and words for nothing", changed(speed_mps=at([3], "NaN"), lat_deg=at([4], "null")), GOOD, "would fill"),
    ("infinite", changed(speed_mps=at([7], "inf"), lat_deg=at([9], "-inf")), GOOD, "2 infinite values dropped"),
    ("no time in some rows", changed(t_s=at([4, 5], "")), GOOD, "2 rows without a time dropped"),
    ("no time in any row", changed(t_s=lambda v: [""] * 1200), BAD, "holds no time in any row"),
    ("time backwards once", rows(lambda k: np.r_[k[:500], k[500:503][::-1], k[503:]]), GOOD, "time went backwards 2"),
    ("rows reversed", rows(lambda k: k[::-1]), GOOD, "rows ran backwards in time: turned around"),
    ("clock restarts", late_restart, BAD, "restarts its clock: row 901"),
    ("rows twice", rows(written_twice), GOOD, "800 rows dropped, each there twice"),
    ("times shuffled", rows(lambda k: np.random.default_rng(1).permutation(k)), GOOD, "no order of time: sorted"),
    ("times all equal", changed(t_s=lambda v: v * 0), BAD, "only one row has a position"),
    ("duplicate rows", rows(lambda k: np.sort(np.r_[k, k[100:110]])), GOOD, "10 rows with the time of the row before"),
    ("duplicate times", changed(t_s=at([10], 0.9)), GOOD, "1 of them with other values, which are dropped"),
    ("clock set on the way", changed(t_s=lambda v: np.where(v < 5, v, v + 1e6)), GOOD, "(clock not set)"),
    ("two drives, days apart", changed(t_s=lambda v: np.where(v < 60, v, v + 3e6)), BAD, "days in time"),
    ("time in milliseconds", changed(t_s=lambda v: v * 1000), GOOD, "time is in milliseconds"),
    ("speed in km/h", changed(speed_mps=lambda v: v * 3.6), GOOD, "speed is in km/h"),
    ("speed in mph", changed(speed_mps=lambda v: v / 0.44704), GOOD, "speed is in mph"),
    ("speed in knots", changed(speed_mps=lambda v: v / 0.514444), GOOD, "speed is in knots"),
    ("yaw rate in deg/s", changed(yaw_rate_radps=np.degrees), GOOD, "yaw rate is in deg/s"),
    ("yaw rate to the right", changed(yaw_rate_radps=lambda v: -v), GOOD, "yaw rate is positive to the right"),
    ("azimuth in degrees", changed(azimuth_rad=np.degrees), GOOD, "degrees clockwise from north"),
    ("azimuth from east", changed(azimuth_rad=lambda v: np.pi / 2 - v), GOOD, "counter-clockwise from east"),
    ("a speed of 9999", changed(speed_mps=at([3], 9999)), GOOD, "1 value of speed_mps beyond 150 dropped"),
    ("a fix far away", changed(lat_deg=lambda v: v + 0.2 * (np.arange(1200) == 700)), GOOD, "that no car could reach"),
    ("latitude and longitude swapped", swapped, GOOD, "were swapped"),
    ("the same, off the Earth", swapped_beyond, GOOD, "were swapped"),
    ("fixes held by the logger", held, GOOD, "1080 fixes repeated by the logger"),
    ("short last row", put(HEAD + ROWS + "41,52.0"), GOOD, "1 row shorter than the header"),
    ("long rows", put(HEAD + ROWS + "41,52,13,1,2,3\n"), GOOD, "1 row longer than the header dropped"),
    ("decimal commas between commas", put(HEAD + "0,0,52,5,13,4,1,0\n1,0,52,6,13,5,1,0\n"), BAD, "decimal commas need"),
    ("a quote that never ends", put(HEAD + '"' + ROWS * 200), LIMIT, "a quoted cell that does not end"),
    ("binary rubbish", put(random.Random(2).randbytes(50_000)), BAD, "is not text"),
    ("zeros", put(b"\0" * 50_000), BAD, "is not text"),
    ("bytes that are no UTF-8", put(HEAD.encode() + b"\xff\xfe\xfa," * 3 + b"\n" + ROWS.encode()), GOOD, "are text"),
    ("a zip archive", put(b"PK\x03\x04" + b"x" * 99), BAD, "is a zip archive or a spreadsheet"),
    ("a web page", put("<!DOCTYPE html><html><body>404</body></html>"), BAD, "is a web page"),
    ("JSON", put('{"lat": 1}'), BAD, "is JSON"),
    ("1e6 columns", put(",".join(f"c{k}" for k in range(1_000_000)) + "\n"), LIMIT, "a line longer than 1024 KiB"),
    ("5000 columns", put(",".join(f"c{k}" for k in range(5000)) + "\n1\n"), LIMIT, "5000 columns in line 1"),
    ("5000 Parquet columns", parquet(n_columns=5000), LIMIT, "has 5000 columns"),
    ("gzip bomb", gz(bomb), LIMIT, "expands more than 100 times"),
    ("gzip of nothing", gz(b""), BAD, "is empty"),
    ("gzip cut off", gz(plain, lambda raw: raw[: len(raw) // 2]), GOOD, "the gzip stream breaks off; the"),
    ("gzip cut off in its head", gz(plain, lambda raw: raw[:15]), BAD, "is empty"),
    ("gzip damaged", gz(plain, lambda raw: raw[:3000] + b"\0" * 99 + raw[3099:]), BAD, "is a damaged gzip file"),
    ("gzip with rubbish behind", gz(plain, lambda raw: raw + b"rubbish"), GOOD, "end of the gzip stream are ignored"),
    ("compressed twice", twice, BAD, "is compressed twice"),
    ("Parquet cut off", parquet(lambda raw: raw[: len(raw) // 2]), BAD, "is a damaged Parquet file"),
    ("Parquet, four bytes", parquet(lambda raw: raw[:4]), BAD, "is a damaged Parquet file"),
    ("Parquet scribbled over", parquet(scribble), BAD, "is a damaged Parquet file"),
    ("a directory", folder_itself, BAD, "is a directory, a log file is expected"),
    ("no such file", lambda folder: str(folder / "nope.csv"), BAD, "no such file or directory"),
    ("a path under a file", under_a_file, BAD, "cannot be read: not a directory"),
    ("a link to itself", endless_link, BAD, "cannot be read"),
    ("a name with NUL", lambda folder: "log\0.csv", BAD, "a path without NUL is expected"),
    ("a name far too long", lambda folder: "x" * 5000, BAD, "cannot be read: file name too long"),
]


@pytest.mark.parametrize(("make", "code", "words"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_bad_log(make, code, words, tmp_path, capfd):
    path = make(tmp_path)
    got = cli.run(["fill", path, "-o", str(tmp_path / "out.csv"), "--dry-run"])
    out, err = capfd.readouterr()
    assert words in err
    assert got == code
    assert out == ""  # words go to standard error
    assert "Traceback" not in err
    assert not (tmp_path / "out.csv").exists()


def test_every_refusal_of_a_layout_says_what_to_type(tmp_path, capfd):
    assert cli.run(["check", put("a,b,c\n1,2,3\n")(tmp_path)]) == BAD
    assert "\nhint: say which column it is: --columns time=NAME,lat=NAME,lon=NAME" in capfd.readouterr().err


def test_a_name_from_the_file_cannot_steer_the_terminal(tmp_path, capfd):
    assert cli.run(["check", put("\x1b[31mred,b,c\n1,2,3\n")(tmp_path)]) == BAD
    assert "\x1b" not in capfd.readouterr().err


MEASURED = """
import sys
from halfwidth.shells.cli import run
code = run(sys.argv[1:])
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(peak, file=sys.stderr)
sys.exit(code)
"""


def measured(args):
    """Run the command line as a process that tells its peak of memory, kB, in its last line."""
    return subprocess.Popen(
        [sys.executable, "-c", MEASURED, *args], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def test_a_line_of_a_gigabyte_stops_early_and_cheap():
    process = measured(["check", "-"])
    sent = 0

    def feed():
        nonlocal sent
        block = b"1234567," * (1 << 14)
        with contextlib.suppress(BrokenPipeError):
            while sent < 1 << 30:
                sent += process.stdin.write(block)

    feeder = threading.Thread(target=feed)
    feeder.start()
    err = process.stderr.read().decode()
    feeder.join()
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    process.stdout.close()
    process.stderr.close()
    assert process.wait() == LIMIT
    assert "has a line longer than 1024 KiB" in err
    assert sent < 8 << 20
    assert int(err.split()[-1]) < 150_000


@pytest.mark.parametrize("make", [gz(bomb), put(",".join("c" * 400_000) + "\n")], ids=["gzip bomb", "4e5 columns"])
def test_a_hostile_file_is_cheap(make, tmp_path):
    process = measured(["check", make(tmp_path)])
    _, err = process.communicate()
    assert process.returncode == LIMIT
    assert int(err.split()[-1]) < 150_000


def test_an_endless_device_is_refused_at_once(capfd):
    started = time.process_time()
    assert cli.run(["check", "/dev/zero"]) == BAD
    assert "is not text" in capfd.readouterr().err
    assert time.process_time() - started < 5


def test_rows_beyond_the_limit_are_refused(tmp_path):
    import halfwidth as hw
    from halfwidth.vehicle import Limits, read

    with pytest.raises(hw.LogTooBig, match="more than 1000 rows"):
        read(save(tmp_path / "log.csv", drive()), limits=Limits(rows=1000))
    with pytest.raises(hw.LogTooBig, match="holds more than 0 MiB"):
        read(save(tmp_path / "log.csv", drive()), limits=Limits(total_bytes=1000))


def test_memory_of_reading_is_bounded_by_what_is_kept():
    """A hundred megabytes of comments nobody needs cost no more than the few numbers beside them."""
    head = b"t_s,lat_deg,lon_deg,comment\n"
    rows = b"".join(b"%d,52.%06d,13.%06d,%s\n" % (k, k, k, b"x" * 2000) for k in range(50_000))
    process = measured(["check", "-"])
    _, err = process.communicate(head + rows)
    assert process.returncode == GOOD, err
    assert int(err.split()[-1]) < 200_000
