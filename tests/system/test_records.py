import json
from dataclasses import asdict, dataclass, field

import pytest

from ugr_lightning.errors import DataError
from ugr_lightning.system.records import parse_json, read_record


@dataclass
class Kept:
    name: str
    share: float
    count: int | None = None
    sizes: list[int] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)


WHOLE = asdict(Kept("a", 0.5, 3, [1, 2], {"fit": 1.5}))


def test_what_was_written_is_read_and_a_whole_number_is_a_float():
    assert read_record(Kept, json.dumps(WHOLE), "f", "Mend it.") == Kept(**WHOLE)
    assert read_record(Kept, b'{"name": "b", "share": 1}', "f", "Mend it.") == Kept("b", 1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": None}, "f, name: expected text, got None. Mend it."),
        ({"share": True}, "f, share: expected a number, got True"),
        ({"count": 1.0}, "f, count: expected a whole number or null, got 1.0"),
        ({"count": 2**63}, "f, count: expected a whole number or null"),
        ({"sizes": [1, "2"]}, "f, sizes: expected a list, each a whole number, got [1, '2']"),
        ({"seconds": {"fit": []}}, "f, seconds: expected an object with values that are a number"),
        ({"nmae": 1}, "f: expected the keys count, name, seconds, share, sizes, got also nmae"),
    ],
)
def test_a_value_of_another_type_or_an_unknown_entry_is_named(change, said):
    with pytest.raises(DataError) as raised:
        read_record(Kept, json.dumps(WHOLE | change), "f", "Mend it.")
    assert said in str(raised.value)


@pytest.mark.parametrize("text", ["", "[1]", "null", '{"name": "a"}', '{"name": "a", "share": 1e999}', b"\xff"])
def test_what_is_no_such_record_is_refused(text):
    with pytest.raises(DataError):
        read_record(Kept, text, "f", "Mend it.")


@pytest.mark.parametrize("text", ['{"a": NaN}', "[-Infinity]", "[" * 100_000])
def test_what_python_reads_beyond_json_is_none(text):
    with pytest.raises(ValueError, match=r"number|nested"):
        parse_json(text)
