import torch
from tiny import TinyPolicy, train

from ugr_lightning.training.callbacks.checkpoints import PolicyCheckpoints


class Scripted(PolicyCheckpoints):
    """Sees values of our choice instead of the logged ones."""

    def __init__(self, values, **arguments):
        super().__init__(**arguments)
        self.values = list(values)

    def on_train_epoch_end(self, trainer, pl_module):
        action_error, loss = self.values[trainer.current_epoch]
        trainer.callback_metrics.update(
            {"val/action_error": torch.tensor(action_error), "val/loss": torch.tensor(loss)}
        )
        super().on_train_epoch_end(trainer, pl_module)


def steps(folder):
    return {path.name: torch.load(path)["global_step"] for path in folder.glob("*.ckpt")}


def test_best_follows_the_monitor_best_loss_the_loss_and_last_the_end(tmp_path, monkeypatch):
    values = [(3.0, 1.0), (1.0, 2.0), (float("nan"), 3.0), (2.0, 0.5)]
    monkeypatch.setattr("tiny.PolicyCheckpoints", lambda: Scripted(values))
    folder = tmp_path / "tiny" / "version_0"
    train(folder, TinyPolicy(), max_epochs=4)
    found = steps(folder)
    assert found == {"policy_best.ckpt": 10, "policy_best_loss.ckpt": 20, "last.ckpt": 20}


def test_a_run_that_ends_inside_an_epoch_still_leaves_its_last_state(tmp_path):
    folder = tmp_path / "tiny" / "version_0"
    train(folder, max_steps=7)
    assert steps(folder)["last.ckpt"] == 7
