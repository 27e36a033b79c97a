from contextlib import suppress

import numpy as np
import pytest
from fake_policy import Reacher

from ugr_lightning.errors import DataError
from ugr_lightning.rollout.evaluate import run_episodes
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.rollout.traces import read_traces

pytestmark = pytest.mark.usefixtures("fake_tasks")


def run(actor, seeds, folder, **more):
    spec = RolloutSpec("reach", seeds, image_size=(4, 6), progress=False, workers=1, traces=folder, **more)
    return run_episodes(actor, spec)


@pytest.fixture
def written(tmp_path):
    """Results of two episodes of a policy and one of a dummy, and the folder of their traces."""
    results = run(Reacher(), [5, 4], tmp_path, execution="2")
    run("zero", [4], tmp_path)
    return results, tmp_path


def test_a_trace_says_when_the_policy_was_asked_and_what_it_answered(written):
    results, folder = written
    traces = read_traces(folder.glob("*.npz"))
    assert [trace.seed for trace in traces] == [4, 5]  # none of the dummy
    for trace, result in zip(traces, reversed(results), strict=True):
        assert (trace.steps, trace.success) == (result.steps, result.success)
        assert trace.query.tolist() == list(range(0, result.steps, 2))
        assert trace.log_variance.shape == (len(trace.query), 5)
        assert trace.chunks.shape == (len(trace.query), 5, 14)
        assert trace.log_variance[0].tolist() == [-1, -2, -3, -4, -5]
        assert trace.contacts.shape == (trace.steps + 1, 2)


class Silent(Reacher):
    def predict(self, observation):
        return super().predict(observation)._replace(log_variance=None)


def test_a_policy_without_uncertainty_leaves_its_chunks(tmp_path):
    run(Silent(), [4], tmp_path)
    (trace,) = read_traces(tmp_path.glob("*.npz"))
    assert trace.chunks.shape == (trace.steps, 5, 14)
    assert trace.log_variance.shape == (trace.steps, 0)


def test_a_damaged_trace_is_named(written):
    _, folder = written
    path = sorted(folder.glob("*.npz"))[0]
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match=path.name):
        read_traces([path])
    np.savez(path, seed=1)
    with pytest.raises(DataError, match=path.name):
        read_traces([path])
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DataError, match=path.name):
        read_traces([path])


def test_a_trace_with_a_flipped_byte_is_read_or_named(written):
    _, folder = written
    path = sorted(folder.glob("*.npz"))[0]
    whole = path.read_bytes()
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x5A]) + whole[place + 1 :])
        with suppress(DataError):  # and nothing else
            read_traces([path])


@pytest.mark.parametrize(
    "change",
    [
        {"seed": np.zeros(3, int)},
        {"steps": np.float64("nan")},
        {"query": np.array(["a"])},
        {"query": np.zeros(0, int)},
        {"chunks": np.zeros((2, 5), np.float16)},
        {"contacts": np.zeros((0, 2), bool)},
        {"log_variance": np.zeros((1, 5), np.float32)},
    ],
)
def test_arrays_that_are_no_trace_together_are_refused(written, change):
    _, folder = written
    path = sorted(folder.glob("*.npz"))[0]
    with np.load(path) as found:
        arrays = dict(found)
    np.savez(path, **arrays)
    assert len(read_traces([path])) == 1
    np.savez(path, **arrays | change)
    with pytest.raises(DataError, match=path.name):
        read_traces([path])
