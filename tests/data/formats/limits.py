"""Reads hostile files in a child, each with 2 s of processor time and 1 GB more than there was before.

A program: cases come as JSON on standard input, what became of each goes to standard output. The kernel keeps the
limits: a child that is over them is gone, or gets no memory, whatever code it is in; another one goes on.
"""

import json
import os
import pickle
import resource
import select
import signal
import sys
import time
from pathlib import Path

SECONDS, BYTES = 2.0, 2**30
PATIENCE_S = 60.0  # of the clock, for a child that waits instead of working


def read_demonstrations(path):
    """What `ugr fit` and `ugr data inspect` read of the first episodes of a folder; returns the first complaint."""
    from ugr_lightning.contract import CAMERAS
    from ugr_lightning.data.formats import detect
    from ugr_lightning.data.inspection import inspect_demonstrations
    from ugr_lightning.data.oddities import find_oddities
    from ugr_lightning.errors import UGRError

    form = detect(path)
    location = next(iter(form.find(path).values()))
    complaint = None
    try:
        cameras = [camera for camera in form.peek(location).cameras if camera in CAMERAS]
        episode = form.read(location, cameras or form.peek(location).cameras)
        for step in {0, 2, episode.length - 1} & set(range(episode.length)):
            episode.images(step)
            episode.frames.jpegs(step)
    except UGRError as error:
        complaint = error
    found = inspect_demonstrations(path, episodes=2)
    find_oddities(found, 50)
    return complaint or next(iter(found.unreadable.values()), None)


def read_statistics(path):
    """`dataset_stats.pkl` of the original ACT."""
    from ugr_lightning.bridges.act_statistics import read_act_statistics

    read_act_statistics(path / "dataset_stats.pkl")


def _loop(path):
    while True:
        pass


def _fail_for_memory(path):
    from ugr_lightning.errors import DataError

    try:
        bytearray(2 * BYTES)
    except MemoryError as error:
        raise DataError(path, "memory", "none", "Buy some.") from error


def _run_pickle(path):
    there = os.getcwd()
    os.chdir(path)
    pickle.loads((path / "dataset_stats.pkl").read_bytes())
    os.chdir(there)


USES = {
    "demonstrations": read_demonstrations,
    "statistics": read_statistics,
    "loop": _loop,
    "wait": lambda path: time.sleep(3600),
    "memory": lambda path: bytearray(2 * BYTES),
    "hidden memory": _fail_for_memory,
    "crash": lambda path: os.abort(),
    "pickle": _run_pickle,
    "nothing": lambda path: None,
}


def _size():
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _chain(error):
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _use(case):
    """In the child: what came of one case, as plain values."""
    from ugr_lightning.errors import UGRError

    resource.setrlimit(resource.RLIMIT_AS, (_size() + BYTES, resource.RLIM_INFINITY))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    start = time.process_time()
    try:
        error = USES[case["use"]](Path(case["path"]))
    except BaseException as raised:
        error = raised
    signal.setitimer(signal.ITIMER_PROF, 0)
    chain = list(_chain(error))
    memory = any(isinstance(one, MemoryError) or "alloc" in str(one).lower() for one in chain)
    return {
        "outcome": "fine" if error is None else type(error).__name__,
        "ours": error is None or isinstance(error, UGRError),
        "out_of_memory": memory,
        "message": "" if error is None else str(error),
        "seconds": time.process_time() - start,
    }


def _work(cases, writing):
    """The child: a line for every case, until it is done or dead."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    for case in cases:
        line = json.dumps(_use(case)).encode() + b"\n"
        while line:
            line = line[os.write(writing, line) :]


def _run(cases):
    """Fork a child for the cases and listen to it; returns what became of the first ones, up to one that was fatal."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _work(cases, writing)
        os._exit(0)
    os.close(writing)
    answers, text, silent = [], b"", False
    while len(answers) < len(cases):
        if not select.select([reading], [], [], cases[len(answers)].get("patience", PATIENCE_S))[0]:
            silent = True
            os.kill(child, signal.SIGKILL)
            break
        part = os.read(reading, 65536)
        if not part:
            break
        *lines, text = (text + part).split(b"\n")
        answers += map(json.loads, lines)
    os.close(reading)
    _, status = os.waitpid(child, 0)
    if len(answers) < len(cases):
        ended = signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else f"exit {status}"
        answers.append({"outcome": "silence" if silent else ended, "ours": False, "seconds": 0.0, "message": ""})
    return answers


def main():
    import av  # noqa: F401 - what readers import late is here before the limits are set
    import pyarrow.parquet  # noqa: F401

    import ugr_lightning.bridges.act_statistics
    import ugr_lightning.data.oddities  # noqa: F401

    cases = json.load(sys.stdin)
    answers = []
    while len(answers) < len(cases):
        answers += _run(cases[len(answers) :])
    json.dump(answers, sys.stdout)


if __name__ == "__main__":
    main()
