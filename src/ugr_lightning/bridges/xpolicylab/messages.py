"""The envelope of XPolicyLab's websocket messages (XPolicyLab/XPolicyLab@7198143, client_server/ws)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from ugr_lightning.errors import ProtocolError

REPLIES = {
    "hello": "hello_ack",
    "prepare_case": "prepare_case_ack",
    "reset": "reset_result",
    "infer": "infer_result",
    "call": "call_result",
    "trial_end": "trial_end_ack",
    "heartbeat": "heartbeat_ack",
}
"""What each request is answered with."""
CLOSE = "close"
LONGEST_NAME = 256
FIX = "Keep to the envelope of XPolicyLab's websocket protocol."


@dataclass(frozen=True)
class Message:
    """One message.

    Args:
        message_type: a key or a value of `REPLIES`, `close` or `error`.
        message_id: the request's; a reply carries that of its request.
        evaluation_id: which evaluation; with `trial_id` it names a client across reconnects.
        action_case_id: which case of it.
        trial_id: which trial of it.
        repeat_index: which repetition of the case.
        step: how many inferences the client has received since its reset.
        payload: what is asked or answered.
    """

    message_type: str
    message_id: str
    evaluation_id: str
    action_case_id: str | None = None
    trial_id: str | None = None
    repeat_index: int | None = None
    step: int = 0
    payload: dict[str, Any] = field(default_factory=dict)

    @property
    def session(self) -> tuple[str, str | None]:
        """Whose environments it is about: the same client's after a reconnect."""
        return self.evaluation_id, self.trial_id

    def reply(self, message_type: str, payload: dict[str, Any]) -> "Message":
        """The answer to this message."""
        return Message(**{**vars(self), "message_type": message_type, "payload": payload})

    def to_message(self) -> dict[str, Any]:
        """What is sent."""
        return vars(self) | {"sent_at": datetime.now(UTC).isoformat()}


def read_message(message: Mapping[str, Any]) -> Message:
    """Check an envelope.

    Raises:
        ProtocolError: a field is missing, unknown, or of another kind.
    """
    known = {*Message.__dataclass_fields__, "sent_at"}
    unknown = [str(name)[:40] for name in message if name not in known]
    if unknown:
        raise ProtocolError("envelope", f"the fields {', '.join(sorted(known))}", f"also {unknown[:5]}", FIX)
    names = {name: _name(message, name) for name in ("message_type", "message_id", "evaluation_id")}
    if None in names.values():
        missing = [name for name, value in names.items() if value is None]
        raise ProtocolError("envelope", ", ".join(names), f"no {', '.join(missing)}", FIX)
    payload = message.get("payload")
    if payload is not None and not isinstance(payload, Mapping):
        raise ProtocolError("payload", "a map", type(payload).__name__, FIX)
    return Message(
        **names,  # type: ignore[arg-type]
        action_case_id=_name(message, "action_case_id"),
        trial_id=_name(message, "trial_id"),
        repeat_index=_count(message, "repeat_index"),
        step=_count(message, "step") or 0,
        payload=dict(payload or {}),
    )


def _name(message: Mapping[str, Any], field: str) -> str | None:
    value = message.get(field)
    if value is None or (isinstance(value, str) and len(value) <= LONGEST_NAME):
        return value
    if type(value) is int:
        return str(value)
    raise ProtocolError(field, f"a text of at most {LONGEST_NAME} letters", type(value).__name__, FIX)


def _count(message: Mapping[str, Any], field: str) -> int | None:
    value = message.get(field)
    if value is None or (type(value) is int and 0 <= value < 2**31):
        return value
    raise ProtocolError(field, "a number from 0", str(value)[:40], FIX)
