"""A policy server that is asked rightly and wrongly, thousands of times."""

import os
import re
import signal
import time
from pathlib import Path

import numpy as np
from deployed import save
from fake_policy import Reacher
from fake_simulator import HOME
from malformed_frames import refused
from trial import Command, Piece, chance
from websockets.sync.client import connect
from xpolicylab_client import AugustClient, Client, observation

MALFORMED, PROPER, WARM = 10_000, 3_000, 500
GROWTH_MB = 20
SIZE = (6, 8)


def _seen(step: int) -> dict[str, object]:
    rng = np.random.default_rng(step)
    return observation(rng.integers(0, 255, (*SIZE, 3), dtype=np.uint8), HOME + rng.uniform(-0.1, 0.1, 14))


def _memory_mb(pid: int | None) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _answered(client: Client, count: int) -> None:
    for step in range(count):
        if step % 100 == 0:
            client.call("reset")
        client.call("update_obs", _seen(step))
        assert np.isfinite([next(iter(part.values())) for part in client.call("get_action")]).all()


def soak(folder: Path, number: int) -> str:
    """Thousands of frames that are none and of requests, old and new, to one server; then it is told to end."""
    checkpoint, trap = save(Reacher(), folder / "reacher.ckpt", image_size=SIZE), folder / "trap"
    command = Command(["bridge", "serve", "--checkpoint", str(checkpoint), "--port", "0"], folder)
    try:
        while (found := re.search(r"listening on (ws://\S+)", command.heard())) is None:
            assert command.process.exitcode is None, command.heard()
            time.sleep(0.05)
        rng, url, pid = chance("soak", number), found[1], command.process.pid
        clients = [Client(url, "july"), AugustClient(url, "august")]
        for client in clients:
            _answered(client, WARM // 2)
        with connect(url, compression=None) as connection:
            count = refused(connection, WARM, rng, trap, _seen(0))
            warm = _memory_mb(pid)
            count += refused(connection, MALFORMED - count, rng, trap, _seen(0))
        for client in clients:
            _answered(client, PROPER // 2)
            client.close()
        grown = _memory_mb(pid) - warm
    finally:
        os.kill(command.process.pid or 0, signal.SIGTERM)
    command.end(128 + signal.SIGTERM)
    assert not trap.exists(), "code from the peer has run"
    assert grown < GROWTH_MB, f"{grown:.1f} MB more"
    return f"{count} refused, {PROPER + WARM} answered, {grown:+.1f} MB of {warm:.0f}"


PIECES = [
    Piece(
        "server",
        f"a policy server gets {MALFORMED} malformed frames and {PROPER} observations",
        "each refused or answered; no code runs; memory flat; it ends on SIGTERM with 143",
        1,
        soak,
    )
]
