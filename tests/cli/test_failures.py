import pytest
from torch import OutOfMemoryError

from ugr_lightning.cli.failures import explain_training
from ugr_lightning.errors import ConfigError, require_extra

FAILURES = {
    "a loader process that was killed": (
        RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed. "),
        "data.num_workers",
    ),
    "shared memory of a container": (
        RuntimeError("DataLoader worker (pid 7) is killed by signal: Bus error. It is possible that ..."),
        "--shm-size",
    ),
    "memory of a GPU": (OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."), "data.batch_size"),
    "memory": (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), "data.batch_size"),
}


@pytest.mark.parametrize("kind", FAILURES)
def test_what_ran_out_in_a_training_is_named_with_the_key_that_helps(kind):
    error, says = FAILURES[kind]
    assert says in str(explain_training(error))


def test_what_a_class_of_ours_refuses_is_told_also_where_only_its_type_was_named():
    refused = ConfigError("data.layout.state", "at least one joint", 0, "Correct the number.")
    outer = ValueError("Does not validate against any of the Union subtypes")
    outer.__cause__ = ValueError("Problem with given class_path")
    outer.__cause__.__cause__ = refused
    assert explain_training(outer) is refused


def test_an_error_of_ours_keeps_its_advice_also_where_an_import_was_its_cause():
    with pytest.raises(ConfigError) as raised:
        require_extra("Diffusion Policy", "diffusion", "no_such_package")
    assert "ugr-lightning[diffusion]" in str(raised.value)
    assert explain_training(raised.value) is None


def test_a_fault_of_our_own_stays_one():
    assert explain_training(RuntimeError("shape '[2]' is invalid")) is None
