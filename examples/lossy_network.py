"""A networked estimator: a sensor and an estimator as processes, UDP on loopback, and a lossy relay between them.

The relay drops a few datagrams and, in bursts and without any mark, replaces the samples of others by noise. What it
drops the estimator can see from the sequence numbers (a known loss); what it replaces only the numbers themselves
betray. Run it without arguments; it ends by itself after `--packets` datagrams or `--seconds` seconds.
"""

import argparse
import dataclasses
import json
import pathlib
import socket
import struct
import subprocess
import sys
import time

import numpy as np

import halfwidth as hw

PACKET = struct.Struct("!Idd")  # sequence number, two outputs
END = 0xFFFFFFFF
LAW = {"stay_received": 0.95, "stay_lost": 0.85}


def model():
    """Return a target at nearly constant velocity, seen to ten metres, that crosses the origin."""
    block = 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]])
    return hw.Linear(
        A=np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]]),
        B=None,
        C=[[1, 0, 0, 0], [0, 0, 1, 0]],
        w=hw.Gaussian(np.kron(np.eye(2), block)),
        e=hw.Gaussian([100.0, 100.0]),
        x0=hw.Normal([-400.0, 4.0, -300.0, 3.0], [100.0, 1.0, 100.0, 1.0]),
        loss=hw.Markov(**LAW),
    )


def truth(packets, seed):
    """Return the trajectory and the samples before the network has touched them."""
    return hw.simulate(dataclasses.replace(model(), loss=None), T=packets, seed=seed)


def listen(seconds):
    """Return a socket on a free port of the loopback interface that waits at most `seconds`."""
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    found.bind(("127.0.0.1", 0))
    found.settimeout(seconds)
    return found


def sensor(args):
    """Send one datagram a sample."""
    _, record = truth(args.packets, args.seed)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for k, y in enumerate(record.y):
            out.sendto(PACKET.pack(k, *y), ("127.0.0.1", args.to))
            time.sleep(1.0 / args.rate)
        for _ in range(3):  # the end may be said more than once
            out.sendto(PACKET.pack(END, 0.0, 0.0), ("127.0.0.1", args.to))
            time.sleep(0.01)


def relay(args):
    """Pass datagrams on: some dropped, some with noise in place of the sample. Prints its port, then what it did."""
    rng = np.random.default_rng(args.seed + 1)
    replaced, dropped, received = [], [], True
    deadline = time.monotonic() + args.seconds
    with listen(args.seconds) as inward, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        print(inward.getsockname()[1], flush=True)
        while time.monotonic() < deadline:
            try:
                k, *y = PACKET.unpack(inward.recv(PACKET.size))
            except TimeoutError:
                break
            if k == END:
                for _ in range(3):
                    out.sendto(PACKET.pack(END, 0.0, 0.0), ("127.0.0.1", args.to))
                break
            received = rng.random() < (LAW["stay_received"] if received else 1 - LAW["stay_lost"])
            if not received:
                y = rng.normal(0.0, 10.0, 2)
                replaced.append(k)
            if rng.random() < 0.03:
                dropped.append(k)
                continue
            out.sendto(PACKET.pack(k, *y), ("127.0.0.1", args.to))
    print(json.dumps({"replaced": replaced, "dropped": dropped}), flush=True)


def estimate(args):
    """Start the others, filter what arrives, print as it goes, and compare with the truth at the end."""
    aware = hw.stream(model(), hw.GPB(depth=3))
    believing = hw.stream(dataclasses.replace(model(), loss=None), hw.KalmanFilter())
    x, gamma, plain = [], [], []

    def push(y):
        newest, other = aware.push(y), believing.push(y)
        x.append(newest.x[0])
        gamma.append(float(newest.gamma[0]))
        plain.append(other.x[0])
        if len(x) % args.every == 0:
            print(f"{len(x):5d}  east {x[-1][0]:8.1f} m  north {x[-1][2]:8.1f} m  P(real) {gamma[-1]:.3f}", flush=True)

    def start(role, to):
        command = [sys.executable, str(pathlib.Path(__file__).resolve()), "--role", role, "--to", str(to)]
        for name in ("packets", "rate", "seconds", "seed"):
            command += [f"--{name}", str(getattr(args, name))]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    deadline = time.monotonic() + args.seconds
    with listen(args.seconds) as inward:
        between = start("relay", inward.getsockname()[1])
        port = int(between.stdout.readline())
        source = start("sensor", port)
        try:
            while time.monotonic() < deadline and len(x) < args.packets:
                try:
                    k, *y = PACKET.unpack(inward.recv(PACKET.size))
                except TimeoutError:
                    break
                if k == END:
                    break
                if not len(x) <= k < args.packets:
                    continue  # late or not ours
                while len(x) < k:
                    push(None)  # a sequence number is missing: a loss that we know of
                push(y)
            report = json.loads(between.communicate(timeout=args.seconds)[0])
            source.communicate(timeout=args.seconds)
        finally:
            for process in (between, source):
                if process.poll() is None:
                    process.kill()
                    process.wait()
    real, _ = truth(args.packets, args.seed)
    n = len(x)
    arrived = np.setdiff1d(np.arange(n), report["dropped"])
    fake = np.isin(arrived, report["replaced"])

    def rmse(found):
        return float(np.sqrt(np.mean(np.sum((np.array(found) - real.x[:n])[:, [0, 2]] ** 2, axis=1))))

    score = {
        "packets": n,
        "replaced": int(fake.sum()),
        "dropped": int(np.sum(np.array(report["dropped"]) < n)),
        "misjudged": float(np.mean((np.array(gamma)[arrived] < 0.5) != fake)),
        "rmse": rmse(x),
        "rmse_believing": rmse(plain),
    }
    print(json.dumps(score))
    return score


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--role", choices=["estimator", "relay", "sensor"], default="estimator")
    parser.add_argument("--packets", type=int, default=300)
    parser.add_argument("--rate", type=float, default=200.0, help="datagrams a second")
    parser.add_argument("--seconds", type=float, default=20.0, help="end after this time whatever happens")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=int, default=25, help="print every so many samples")
    parser.add_argument("--to", type=int, default=0, help="port (of the relay or of the estimator)")
    args = parser.parse_args(arguments)
    return {"estimator": estimate, "relay": relay, "sensor": sensor}[args.role](args)


if __name__ == "__main__":
    main()
