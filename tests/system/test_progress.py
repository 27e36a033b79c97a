import io

from ugr_lightning.system import progress
from ugr_lightning.system.progress import Progress


def test_piped_output_gets_plain_lines_with_the_time_left(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with Progress("recording", 10, done=4, stream=stream) as line:
        now[0] = 10.0
        line.advance("seed 4")
        now[0] = 11.0
        line.advance()
    assert stream.getvalue() == "recording: 5/10, 0:10 elapsed, 0:50 left, seed 4\n"


def test_the_last_line_is_always_written():
    stream = io.StringIO()
    with Progress("recording", 1, stream=stream) as line:
        line.advance()
    assert stream.getvalue().startswith("recording: 1/1")


def test_a_hidden_progress_still_says_what_matters():
    stream = io.StringIO()
    with Progress("recording", 1, shown=False, stream=stream) as line:
        line.advance()
        line.message("seed 2 skipped")
    assert stream.getvalue() == "seed 2 skipped\n"


def test_a_terminal_gets_a_bar():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    with Progress("recording", 2, stream=stream) as line:
        line.advance("seed 0")
        line.message("[seed 1] skipped")
        line.advance()
    assert "2/2" in stream.getvalue()
    assert "[seed 1] skipped" in stream.getvalue()
