"""Noise and back: with a score that is known, sampling gives the distribution that is known."""

import sys

import pytest
import torch
from scipy import stats

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.noise_process import NoiseProcess

CPU = torch.device("cpu")
WEIGHTS, MEANS, WIDTH = torch.tensor([0.3, 0.7]), torch.tensor([-0.5, 0.4]), 0.1


def exact_prediction(process: NoiseProcess):
    """What a perfect network predicts where the clean numbers are from a mixture of two normal distributions."""

    def denoise(noisy, step):
        kept = process.scheduler.alphas_cumprod[step[0]]  # share of the clean variance that is left
        variance = kept * WIDTH**2 + 1 - kept
        distance = noisy[..., None] - kept.sqrt() * MEANS  # (B, L, A, 2)
        nearness = (WEIGHTS.log() - distance.square() / (2 * variance)).softmax(-1)
        score = -(nearness * distance).sum(-1) / variance
        noise = -(1 - kept).sqrt() * score
        clean = (noisy - (1 - kept).sqrt() * noise) / kept.sqrt()
        return noise if process.prediction == "epsilon" else clean

    return denoise


def mixture_cdf(x):
    return sum(float(w) * stats.norm.cdf(x, float(m), WIDTH) for w, m in zip(WEIGHTS, MEANS, strict=True))


def draw(process, denoise, count=20_000):
    return process.sample(denoise, (1, count, 1), 0, CPU).flatten()


@pytest.mark.parametrize("prediction", ["epsilon", "sample"])
@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
def test_sampling_with_the_known_score_recovers_the_known_distribution(prediction, sampler):
    process = NoiseProcess(100, sampler, 100, prediction)
    drawn = draw(process, exact_prediction(process))
    assert stats.kstest(drawn.numpy(), mixture_cdf).statistic < 0.03
    assert (drawn < 0).float().mean().item() == pytest.approx(0.3, abs=0.01)
    for mean, part in zip(MEANS, (drawn[drawn < 0], drawn[drawn >= 0]), strict=True):
        assert part.mean().item() == pytest.approx(float(mean), abs=0.01)
        assert part.std().item() == pytest.approx(WIDTH, rel=0.12)  # 100 steps with the small variance narrow it


def test_ten_steps_without_noise_find_both_modes_in_their_proportion():
    process = NoiseProcess(100, "ddim", 10)
    drawn = draw(process, exact_prediction(process))
    assert (drawn < 0).float().mean().item() == pytest.approx(0.3, abs=0.01)
    assert drawn[drawn < 0].median().item() == pytest.approx(-0.5, abs=0.05)
    assert drawn[drawn >= 0].median().item() == pytest.approx(0.4, abs=0.05)


def test_a_score_that_is_wrong_gives_another_distribution():
    process = NoiseProcess()
    exact = exact_prediction(process)
    drawn = draw(process, lambda noisy, step: exact(noisy + 0.1, step))
    assert stats.kstest(drawn.numpy(), mixture_cdf).statistic > 0.06


@pytest.mark.parametrize("prediction", ["epsilon", "sample"])
def test_what_the_network_has_to_predict_leads_back_to_the_clean_chunk(prediction):
    process = NoiseProcess(100, "ddim", 1, prediction)
    clean, noise = 2 * torch.rand(1, 4, 2) - 1, torch.randn(1, 4, 2)
    for step in (0, 30, 70):
        noisy, wanted = process.corrupt(clean, noise, torch.tensor([step]))
        process.scheduler.num_inference_steps = 1  # from here to the clean chunk in one step
        back = process.scheduler.step(wanted, step, noisy).pred_original_sample
        assert torch.allclose(back, clean, atol=1e-4)


def test_the_last_diffusion_step_is_noise_and_the_first_is_nearly_clean():
    process = NoiseProcess()
    clean, noise = torch.ones(2, 3, 1), torch.zeros(2, 3, 1)
    noisy, _ = process.corrupt(clean, noise, torch.tensor([0, 99]))
    assert noisy[0].min() > 0.99
    assert noisy[1].max() < 0.05


@pytest.mark.parametrize(("sampler", "steps"), [("ddpm", 100), ("ddim", 10)])
def test_rows_come_out_equal_in_a_batch_of_any_size_and_the_seed_decides(sampler, steps):
    process = NoiseProcess(100, sampler, steps)
    denoise = exact_prediction(process)
    one = process.sample(denoise, (1, 5, 2), 7, CPU)
    three = process.sample(denoise, (3, 5, 2), 7, CPU)
    assert torch.equal(three, one.expand(3, -1, -1))
    assert not torch.equal(process.sample(denoise, (1, 5, 2), 8, CPU), one)


def test_sampling_leaves_the_random_numbers_of_training_alone():
    process = NoiseProcess(10, "ddpm", 10)
    before = torch.get_rng_state()
    process.sample(exact_prediction(process), (2, 4, 1), 0, CPU)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [((10, "ddpm", 11), "sampling_steps"), ((10, "ddpm", 0), "sampling_steps"), ((10, "euler", 5), "sampler"),
     ((10, "ddim", 5, "v_prediction"), "prediction")],
)  # fmt: skip
def test_impossible_settings_are_refused_by_name(arguments, named):
    with pytest.raises(ConfigError, match=named):
        NoiseProcess(*arguments)


def test_without_diffusers_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "diffusers.schedulers.scheduling_ddim", None)
    with pytest.raises(ConfigError, match=r"pip install 'ugr-lightning\[diffusion\]'"):
        NoiseProcess()
