import io

from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import train

from ugr_lightning.training.callbacks.figures import ValidationFigures
from ugr_lightning.training.tensorboard import log_image


def test_a_validation_leaves_figures_and_a_gif_stays_animated(tmp_path):
    folder = tmp_path / "tiny" / "version_0"
    trainer = train(folder, callbacks=[ValidationFigures()], max_steps=5)
    frames = [Image.new("RGB", (8, 6), color) for color in ("red", "green", "blue")]
    buffer = io.BytesIO()
    frames[0].save(buffer, format="GIF", save_all=True, append_images=frames[1:])
    log_image(trainer.loggers, "rollout/episode", buffer.getvalue(), 5)
    trainer.loggers[0].experiment.flush()

    events = EventAccumulator(str(folder), size_guidance={"images": 0}).Reload()
    assert {"figures/chunk", "figures/error_by_step", "rollout/episode"} <= set(events.Tags()["images"])
    assert {"val/action_error", "train/loss", "val/spearman"} <= set(events.Tags()["scalars"])
    [gif] = events.Images("rollout/episode")
    with Image.open(io.BytesIO(gif.encoded_image_string)) as image:
        assert image.n_frames == 3
        assert (gif.width, gif.height) == (8, 6)
