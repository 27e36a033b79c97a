import torch

from ugr_lightning.speed.reference_act import ReferenceACT


def test_layers_behind_the_first_are_computed_but_get_no_gradient():
    sizes = {"dim": 32, "feedforward": 48, "heads": 4, "encoder_layers": 1, "cvae_layers": 1, "latent_dim": 4}
    reference = ReferenceACT(**sizes, decoder_layers=3, chunk_length=6, backbone_width=8)
    images, state = torch.rand(2, 3, 3, 64, 64), torch.randn(2, 14)
    reference.loss(images, state, torch.randn(2, 6, 14), torch.ones(2, 6, dtype=torch.bool)).backward()
    first, second, _ = reference.transformer.decoder.layers
    assert first.linear1.weight.grad.abs().sum() > 0
    assert second.linear1.weight.grad.abs().sum() == 0
