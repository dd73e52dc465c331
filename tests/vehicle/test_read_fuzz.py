"""Readers survive anything: mutated files end in a log or in a typed refusal, nothing else."""

import gzip
import io
import random
import subprocess
import sys
import warnings

import numpy as np
import pytest
from tests.vehicle.drives import drive, text

import halfwidth as hw

PLAIN = text(drive(120, dt=0.2)).encode()
TOKENS = [
    b"nan", b"inf", b"-inf", b"1e999", b"-", b"", b",", b",,,,,", b"\n", b"\r", b"\0", b'"', b"'", b"#", b";", b"\t", b"9" * 400,
    b"1_0", b"0x10", b"\xff", b"\xef\xbb\xbf", b"12:34:56", b"2024-02-30", b"9999-12-31T23:59:59Z", b"0001-01-01", b"lat", b"t_s",
    b"1e18", b"-1e18", b"1e308", b"5e-324", "١٢".encode(), b"\x1b[2J", b"T", b"Z", b"N", b"1,5", b"[km/h]",
]  # fmt: skip


def mutated(raw: bytes, rng: random.Random) -> bytes:
    """Change some bytes, cut, repeat, or put tokens in."""
    out = bytearray(raw)
    for _ in range(rng.choice((1, 1, 2, 5, 30))):
        kind = rng.randrange(6)
        at = rng.randrange(len(out) + 1)
        if rng.random() < 0.3:
            at = min(at, rng.randrange(200))  # the header and the first rows matter most
        if kind == 0 and out:
            out[at % len(out)] = rng.randrange(256)
        elif kind == 1:
            del out[at : at + rng.randrange(60)]
        elif kind == 2:
            out[at:at] = rng.choice(TOKENS)
        elif kind == 3:
            out[at:at] = out[at : at + rng.randrange(300)]
        elif kind == 4:
            other = rng.randrange(len(out) + 1)
            out[at : at + 40], out[other : other + 40] = out[other : other + 40], out[at : at + 40]
        else:
            end = out.find(b",", at)
            if end > 0:
                start = out.rfind(b",", 0, end)
                out[start + 1 : end] = rng.choice(TOKENS)
        if not out:
            out = bytearray(b"x")
    if rng.random() < 0.1:
        del out[rng.randrange(len(out)) :]
    return bytes(out)


def sane(log):
    """Assert what every log promises."""
    assert np.isfinite(log.t).all()
    assert (np.diff(log.t) > 0).all()
    assert log.fixed.sum() >= 2
    assert np.nanmax(np.abs(log.lat_deg)) <= 90
    assert np.nanmax(np.abs(log.lon_deg)) <= 360


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzip"])
def test_mutated_text(packed, tmp_path):
    rng = random.Random(7)
    path = tmp_path / "log.csv"
    outcomes = {"log": 0, "refused": 0}
    for k in range(500):
        raw = mutated(PLAIN, rng)
        if packed:
            raw = gzip.compress(raw, compresslevel=1, mtime=0)
            if rng.random() < 0.5:
                raw = mutated(raw, rng)
        path.write_bytes(raw)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                log = hw.vehicle.read(path)
            except hw.BadLog:
                outcomes["refused"] += 1
                continue
            sane(log)
            if k % 4 == 0:
                hw.vehicle.check(log).to_dict()
                sane(hw.vehicle.read(path, repair=False))
            outcomes["log"] += 1
    assert min(outcomes.values()) > 20, outcomes


PARQUET = """
import random, sys
import numpy as np
import halfwidth as hw
sys.path.insert(0, sys.argv[2])
from tests.vehicle.test_read_fuzz import mutated, sane
rng = random.Random(3)
good = open(sys.argv[1], "rb").read()
seen = {"log": 0, "refused": 0}
for _ in range(300):
    raw = mutated(good, rng)
    if not raw.startswith(b"PAR1"):
        raw = b"PAR1" + raw[4:]
    with open(sys.argv[1], "wb") as file:
        file.write(raw)
    try:
        sane(hw.vehicle.read(sys.argv[1]))
        seen["log"] += 1
    except hw.BadLog:
        seen["refused"] += 1
print(seen)
"""


def test_mutated_parquet(tmp_path, pytestconfig):
    import pyarrow
    from pyarrow import parquet

    out = io.BytesIO()
    parquet.write_table(pyarrow.table(drive(120, dt=0.2)), out)
    path = tmp_path / "log.parquet"
    path.write_bytes(out.getvalue())
    # in a process of its own: the decoder is native code
    found = subprocess.run(
        [sys.executable, "-c", PARQUET, str(path), str(pytestconfig.rootpath)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
