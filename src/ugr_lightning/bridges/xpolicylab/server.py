"""A websocket server for XPolicyLab's environment clients; answers on loopback unless told otherwise."""

import asyncio
import logging
import signal
import time
import uuid
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import FrameType
from typing import Any

from ugr_lightning.bridges.xpolicylab.codec import BYTES_OF_ENVIRONMENT, pack, unpack
from ugr_lightning.bridges.xpolicylab.messages import CLOSE, REPLIES, Message, read_message
from ugr_lightning.bridges.xpolicylab.model import XPolicyModel
from ugr_lightning.errors import ConfigError, ProtocolError, UGRError, require_extra
from ugr_lightning.system.signals import handled

LOOPBACK = "127.0.0.1"
PORT = 19000
FAILURES = {"infer": "infer_failed", "reset": "reset_failed", "call": "call_failed"}
INTERNAL, INVALID_FRAME = "internal", "invalid_frame"
FUNCTIONS = ("update_obs", "get_action", "update_obs_batch", "get_action_batch", "infer", "reset", "prepare_case")
"""What a `call` may ask for; `on_trial_end` and `trial_end` besides."""
REMEMBERED, REMEMBERED_BYTES = 256, 16 * 2**20  # replies that are kept for requests that are sent again
logger = logging.getLogger(__name__)


class PolicyServer:
    """Answers XPolicyLab's requests with a model.

    Speaks what XPolicyLab's clients sent until July 2026 (`infer`, with the observation) and since (`call`, a function
    of the model by name; all environments in one message). One request is computed at a time. A client is known by
    `evaluation_id` and `trial_id`, so it may reconnect in the middle of an episode; a request that is sent again under
    its `message_id` is answered again and not computed again. What is no proper request is answered with an error and
    changes nothing. Browsers are refused: a web page could otherwise talk to a server on the same machine.

    Args:
        model: the policy.
        host: where to listen.
        port: where to listen; 0 takes a free one.

    Source: XPolicyLab/XPolicyLab@7198143, client_server/ws/model_server.py.
    """

    def __init__(self, model: XPolicyModel, host: str = LOOPBACK, port: int = PORT) -> None:
        require_extra("XPolicyLab", "xpolicylab", "msgpack", "websockets")
        self.model, self.host, self.port = model, host, port
        self.identity = uuid.uuid4().hex  # clients see by it that the server was started anew
        self.most_bytes = BYTES_OF_ENVIRONMENT * model.environments
        self._compute = ThreadPoolExecutor(1, "policy")  # one request at a time, and off the event loop
        self._answered: dict[str, tuple[Message, bytes]] = {}  # envelopes and replies; oldest first

    @property
    def url(self) -> str:
        """Where clients connect to."""
        return f"ws://{self.host}:{self.port}"

    async def serve(self, started: Callable[[str], None]) -> signal.Signals:
        """Serve until a signal asks to end, or until it is cancelled.

        Args:
            started: called with the url as soon as clients can connect.

        Returns:
            The signal.

        Raises:
            ConfigError: the address cannot be listened on.
        """
        from websockets.asyncio.server import serve

        loop = asyncio.get_running_loop()
        ended, signals = asyncio.Event(), list[signal.Signals]()

        def end(number: int, frame: FrameType | None) -> None:  # not in the midst of an answer, as raising would be
            signals.append(signal.Signals(number))
            loop.call_soon_threadsafe(ended.set)

        try:
            server = await serve(
                self._talk, self.host, self.port, max_size=self.most_bytes, compression=None, origins=[None]
            )
        except OSError as error:
            fix = "Choose another port, or 0 for a free one."
            raise ConfigError("address", "one to listen on", f"{self.url} ({error.strerror})", fix) from error
        with self._compute, handled(end):
            async with server:
                self.port = next(iter(server.sockets)).getsockname()[1]
                started(self.url)
                await ended.wait()
        return signals[0]

    async def _talk(self, connection: Any) -> None:
        """One request after the other, each answered before the next is read."""
        from websockets.exceptions import ConnectionClosed

        try:
            async for message in connection:
                reply = await self.answer(message, connection.id)
                if reply is None:
                    return
                await connection.send(reply)
        except ConnectionClosed:
            logger.info("a client has gone without saying so")
        finally:
            self._compute.submit(self.model.disconnect, connection.id)

    async def answer(self, message: bytes | str, client: Hashable = None) -> bytes | None:
        """The reply to a websocket message; None ends the connection.

        Args:
            message: bytes of a frame; texts are refused.
            client: the connection it came on.
        """
        content: Mapping[str, Any] = {}
        try:
            if isinstance(message, str):
                raise ProtocolError("frame", "bytes", "a text", "Send msgpack.")
            content = unpack(message, self.most_bytes)
            frame = read_message(content)
        except ProtocolError as error:
            return pack(_refusal(content, error).to_message())
        if frame.message_type == CLOSE:
            return None
        return await asyncio.get_running_loop().run_in_executor(self._compute, self._answer_once, frame, client)

    def _answer_once(self, frame: Message, client: Hashable) -> bytes:
        """The reply to a request; the same again, without computing it again, where the request is."""
        if frame.message_type not in REPLIES:
            kinds = f"requests are {', '.join(REPLIES)} and {CLOSE}"
            return pack(_error(frame, "unknown_message_type", kinds).to_message())
        envelope = replace(frame, payload={})
        if frame.message_id in self._answered:
            known, reply = self._answered[frame.message_id]
            if known != envelope:
                other = f"message_id {frame.message_id} was that of another {known.message_type}"
                return pack(_error(frame, INVALID_FRAME, f"{other}; give each request its own").to_message())
            return reply
        reply = pack(self._reply(frame, client).to_message())
        self._answered[frame.message_id] = (envelope, reply)
        while len(self._answered) > REMEMBERED or sum(len(r) for _, r in self._answered.values()) > REMEMBERED_BYTES:
            self._answered.pop(next(iter(self._answered)))
        return reply

    def _reply(self, frame: Message, client: Hashable) -> Message:
        try:
            payload = self._payload(frame, client)
            alarms = self.model.alarms(frame.session)
            return frame.reply(REPLIES[frame.message_type], {**payload, "alarms": alarms} if alarms else payload)
        except UGRError as error:
            return _error(frame, FAILURES.get(frame.message_type, INTERNAL), str(error))
        except Exception:  # whatever it is, the client learns that it happened and the log what it was
            logger.exception("a %s failed", frame.message_type)
            return _error(frame, FAILURES.get(frame.message_type, INTERNAL), "the policy failed; see the server's log")

    def _payload(self, frame: Message, client: Hashable) -> dict[str, Any]:
        whose = {"session": frame.session, "client": client}
        if frame.message_type == "infer":
            start = time.perf_counter()
            observation = frame.payload.get("observation")
            if not isinstance(observation, Mapping):
                raise ProtocolError("payload", "a map `observation`", type(observation).__name__, "Send one.")
            actions = self.model.infer(observation, **whose, step=frame.step, request=frame.message_id)
            return {"actions": actions, "latency_ms": 1000 * (time.perf_counter() - start)}
        if frame.message_type == "call":
            start = time.perf_counter()
            found = self._call(frame.payload.get("func_name"), frame.payload.get("obs"), whose)
            result = {} if found is None else {"result": found}
            return {"ok": True, **result, "latency_ms": 1000 * (time.perf_counter() - start)}
        if frame.message_type in ("reset", "trial_end"):
            self.model.reset(**whose)
        if frame.message_type == "hello":
            return {"ok": True, "server": "ugr-lightning", "server_instance_id": self.identity}
        return {"ok": True}

    def _call(self, function: Any, obs: Any, whose: dict[str, Any]) -> Any:
        """A function of the model by its name, as XPolicyLab's clients call it.

        Raises:
            ProtocolError: there is no such function, or it misses what it needs.
        """
        if function in ("reset", "on_trial_end", "trial_end"):
            return self.model.reset(**whose)
        if function not in FUNCTIONS:
            fix = "Update ugr-lightning if XPolicyLab has it."
            raise ProtocolError("func_name", f"one of {', '.join(FUNCTIONS)}", repr(function)[:80], fix)
        if function in ("update_obs", "update_obs_batch", "infer") and obs is None:
            raise ProtocolError(f"call {function}", "an observation as `obs`", "none", "Send it.")
        if function == "infer" or (function == "get_action" and obs is not None):
            self.model.update_obs(obs, **whose)
            return self.model.get_action(**whose)
        if function == "get_action":
            return self.model.get_action(**whose)
        if function == "prepare_case":
            return None
        return getattr(self.model, function)(obs, **whose)


def _refusal(content: Mapping[str, Any], error: ProtocolError) -> Message:
    """The answer to a frame that is none, under whatever name can be made out."""
    name, evaluation = (str(content.get(field) or "")[:256] for field in ("message_id", "evaluation_id"))
    return _error(Message("", name, evaluation), INVALID_FRAME, str(error))


def _error(frame: Message, code: str, message: str) -> Message:
    return frame.reply("error", {"code": code, "message": message[:1000], "details": {}})
