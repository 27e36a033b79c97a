import pytest

from ugr_lightning.errors import RenderError
from ugr_lightning.sim import render


@pytest.fixture(autouse=True)
def _fresh():
    render.probe_rendering.cache_clear()
    yield
    render.probe_rendering.cache_clear()


def test_this_machine_renders_a_picture():
    probe = render.probe_rendering()
    assert probe.ok, probe.message
    render.require_rendering()


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        ("import os; os.abort()", "signal 6"),
        ("raise RuntimeError('failed to find a rendering device')", "failed to find a rendering device"),
        ("import sapien_is_not_here", "pip install sapien"),
        ('print(\'UGR{"device": "x", "centre": [0, 0, 0]}\')', "wrong picture"),
    ],
)
def test_whatever_goes_wrong_becomes_a_message_that_says_what_to_do(monkeypatch, program, expected):
    monkeypatch.setattr(render, "_PROGRAM", program)
    probe = render.probe_rendering()
    assert not probe.ok
    assert expected in probe.message
    assert "install" in probe.message
    with pytest.raises(RenderError, match="install"):
        render.require_rendering()


def test_a_driver_that_hangs_is_given_up(monkeypatch):
    monkeypatch.setattr(render, "_PROGRAM", "import threading; threading.Event().wait()")
    assert "hung" in render.probe_rendering(0.5).message


def test_the_device_can_be_chosen(monkeypatch):
    monkeypatch.setenv("UGR_RENDER_DEVICE", "cuda:1")
    assert render.render_device() == "cuda:1"
    monkeypatch.delenv("UGR_RENDER_DEVICE")
    assert render.render_device() == "cpu"
