import os
import signal
import threading
from functools import partial

import pytest

from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.system.workers import Worker, WorkerLostError, start_all, wait_for_any


class Echo:
    def __init__(self, wrong=None):
        if wrong:
            raise wrong

    def say(self, text):
        return text, os.getpid(), os.environ["OMP_NUM_THREADS"]

    def fail(self, error):
        raise error

    def hang(self):
        threading.Event().wait()

    def die(self):
        os.kill(os.getpid(), signal.SIGKILL)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_worker_answers_fails_and_is_reaped():
    with Worker(Echo) as worker:
        worker.receive()
        worker.send("say", "hello")
        text, pid, threads = worker.receive()
        assert (text, threads) == ("hello", "1")
        assert pid != os.getpid()
        worker.send("fail", ConfigError("here", "a", "b", "Do c."))
        with pytest.raises(ConfigError, match="here: expected a, got b"):
            worker.receive()
        worker.send("fail", ValueError("odd"))
        with pytest.raises(SimulationError, match=r"test_workers\.py: .*ValueError: odd \(.*Correct the file\."):
            worker.receive()
        worker.send("no_method")
        with pytest.raises(SimulationError, match=r"AttributeError: .*Report this"):
            worker.receive()
        worker.send("say", "still there")
        assert worker.receive()[1] == pid
    assert not alive(pid)
    assert worker.pid is None


def test_a_killed_worker_is_noticed_and_can_be_launched_again():
    with Worker(Echo, "simulator process 1") as worker:
        worker.receive()
        worker.send("die")
        assert wait_for_any([worker], 60) == [worker]
        with pytest.raises(WorkerLostError, match="simulator process 1 was ended by SIGKILL"):
            worker.receive()
        start_all([worker])
        worker.send("say", "again")
        assert worker.receive()[0] == "again"


def test_a_hanging_worker_is_killed():
    with Worker(Echo) as worker:
        worker.receive()
        pid = worker.pid
        worker.send("hang")
        with pytest.raises(WorkerLostError, match="did not answer"):
            worker.receive(0.2)
        assert not alive(pid)


def test_what_building_the_object_raises_arrives_as_it_is():
    worker = Worker(partial(Echo, ConfigError("task", "one", "none", "Choose.")))
    with pytest.raises(ConfigError, match="task: expected one"):
        start_all([worker])
    worker.kill()


def test_a_process_that_never_starts_is_one_clear_error():
    worker = Worker(partial(os._exit, 3), "simulator process 1")
    with pytest.raises(SimulationError, match=r"exit code 3. Run `ugr doctor`"):
        start_all([worker])
