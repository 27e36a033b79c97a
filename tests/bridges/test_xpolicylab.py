"""The adapter for XPolicyLab: its model, and its server over real sockets."""

import asyncio
import gc
import importlib
import resource
import subprocess
import sys
import tracemalloc
import types
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from deployed import Recaller, looking_act, save, tiny_act
from fake_policy import Reacher
from fake_simulator import HOME, FakeSimulator
from foreign_files import marked_jpeg

from ugr_lightning.bridges.deployment import Deployment, Sight, scaled
from ugr_lightning.bridges.xpolicylab import codec
from ugr_lightning.bridges.xpolicylab.adapter import read_deployment, write_adapter
from ugr_lightning.bridges.xpolicylab.model import CAMERAS, XPolicyModel, find_checkpoint, read_observation
from ugr_lightning.contract import Statistics
from ugr_lightning.data.storage.jpeg import encode_jpeg
from ugr_lightning.embodiment import image_projection
from ugr_lightning.errors import CheckpointError, ConfigError, ProtocolError
from ugr_lightning.models.checkpoint import sha256
from ugr_lightning.rollout.actors import PolicyActor
from ugr_lightning.rollout.alarm import Alarm, write_alarms

pytest.importorskip("msgpack", reason="the extra `xpolicylab` is not installed")
pytest.importorskip("websockets", reason="the extra `xpolicylab` is not installed")

import msgpack
from malformed_frames import refused
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from xpolicylab_client import (
    AugustClient,
    Client,
    Direct,
    Environments,
    array_to_map,
    encode,
    joints_of,
    observation,
    request,
    served,
)

from ugr_lightning.bridges.xpolicylab.server import PolicyServer

SIZE = (6, 8)


@pytest.fixture(scope="module")
def reacher(tmp_path_factory):
    return save(Reacher(), tmp_path_factory.mktemp("run") / "policy_best.ckpt", image_size=SIZE)


def serve(checkpoint, **config):
    return served(XPolicyModel({"checkpoint": str(checkpoint), **config}))


def seen(environment, step, size=SIZE):
    """What an environment shows at a step: different for every one of both."""
    rng = np.random.default_rng((environment, step))
    picture = np.full((*size, 3), 40 + rng.integers(0, 30), np.uint8)
    return observation(picture, HOME + rng.uniform(-0.1, 0.1, 14), environment)


def alone(checkpoint, environment, steps, execution="aggregate"):
    """The actions that an environment gets when it has the policy for itself."""
    policy = Deployment(checkpoint, cameras=CAMERAS, execution=execution)
    plans = []
    for step in range(steps):
        one = seen(environment, step)
        joints = np.concatenate([one["state"][part] for part in one["state"] if part.endswith("joint_state")])
        pictures = {name: view["color"] for name, view in one["vision"].items()}
        plans.append(policy.act({0: policy.see(pictures, joints)})[0])
    return plans


def vectors(actions):
    return np.stack([joints_of(action) for action in actions])


def fakes(seeds):
    return Environments([FakeSimulator("reach", image_size=(30, 40)) for _ in seeds], seeds)


@pytest.fixture
def adapter(tmp_path, monkeypatch):
    """Writes an adapter folder into a stand-in of XPolicyLab's package and imports a module of it."""
    lab = tmp_path / "XPolicyLab"
    for folder in (lab, lab / "policy"):
        folder.mkdir(parents=True)
        (folder / "__init__.py").touch()
    (lab / "model_template.py").write_text("class ModelTemplate:\n    def reset(self): raise NotImplementedError\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in sys.modules if name.split(".")[0] == "XPolicyLab"]:
        monkeypatch.delitem(sys.modules, name)

    def write(checkpoint, **options):
        write_adapter(checkpoint, lab / "policy" / "UGR", **options)
        return lambda module: importlib.import_module(f"XPolicyLab.policy.UGR.{module}")

    return write


@pytest.mark.parametrize("execution", ["aggregate", 4])
@pytest.mark.parametrize(
    "policy", [Reacher(), Recaller(), tiny_act(), looking_act()], ids=["reacher", "recaller", "act", "keyframes"]
)
def test_xpolicylabs_loop_moves_as_in_our_own_rollout(adapter, rolled_out, tmp_path, policy, execution):
    seeds, folder = [0, 5, 6, 1], tmp_path / "XPolicyLab" / "policy" / "UGR"
    module = adapter(save(policy, tmp_path / "a.ckpt"), execution=execution, copy=True)
    expected = [rolled_out(policy, seeds, execution)[seed] for seed in seeds]
    model, deploy = module("model").Model(read_deployment(folder, {})), module("deploy")
    batch = fakes(seeds)
    deploy.eval_one_episode_batch(batch, Direct(model))
    assert batch.outcomes() == expected, "all at once"
    with served(module("model").Model(read_deployment(folder, {}))) as server:
        for kind in (Client, AugustClient):
            with closing(kind(server.url)) as client:
                for seed, outcome in zip(seeds, expected, strict=True):
                    single = fakes([seed])
                    deploy.eval_one_episode(single, client)
                    assert single.outcomes() == [outcome], f"one after the other, over a socket, {kind.__name__}"
                batch = fakes(seeds)
                deploy.eval_one_episode_batch(batch, client)
                assert batch.outcomes() == expected, f"all at once, over a socket, {kind.__name__}"


def test_a_thousand_requests_of_eight_environments_with_reconnects_each_get_their_own_reply(reacher):
    steps, environments = 125, 8
    expected = {index: alone(reacher, index, steps) for index in range(environments)}

    def drive(url, index):
        rng, client = np.random.default_rng(index), Client(url, trial=f"worker {index % 4}")
        replies, resent = [], 0
        for step in range(steps):
            client.step = step
            one, name = seen(index, step), f"{index} {step}"
            actions = client.infer(one, name=name)
            if rng.random() < 0.1:  # the reply was lost on the way: connect anew and ask again
                client.reconnect()
                again = client.infer(one, **({"name": name} if rng.random() < 0.5 else {}))
                assert np.array_equal(vectors(again), vectors(actions))
                resent += 1
            replies.append(vectors(actions))
        client.close()
        return replies, resent

    with serve(reacher) as server, ThreadPoolExecutor(environments) as pool:
        found = list(pool.map(lambda index: drive(server.url, index), range(environments)))
    assert sum(resent for _, resent in found) > 50
    for index, (replies, _) in enumerate(found):
        assert all(np.array_equal(mine, own) for mine, own in zip(replies, expected[index], strict=True)), index


def memory_mb():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def test_ten_thousand_malformed_frames_are_refused_politely_and_leave_nothing_behind(reacher, tmp_path, caplog):
    rng, trap = np.random.default_rng(0), tmp_path / "trap"
    with serve(reacher) as server, closing(Client(server.url)) as good:
        first = vectors(good.infer(seen(0, 0)))
        with connect(server.url, compression=None) as connection:
            refused(connection, 1_000, rng, trap, seen(0, 0))
            warm = memory_mb()
            refused(connection, 9_000, rng, trap, seen(0, 0))
        assert memory_mb() - warm < 20
        good.step = 1
        second = vectors(good.infer(seen(0, 1)))
    expected = alone(reacher, 0, 2)
    assert np.array_equal(first, expected[0])
    assert np.array_equal(second, expected[1]), "another client's episode has not noticed"
    assert not trap.exists(), "code from the peer has run"
    assert not [record for record in caplog.records if record.exc_info], "nothing failed inside"


def test_a_frame_beyond_the_limit_ends_its_connection_only(reacher):
    with serve(reacher, environments=2) as server:
        with connect(server.url, compression=None, max_size=None) as connection:
            connection.send(b"\0" * (2 * codec.BYTES_OF_ENVIRONMENT + 1))
            with pytest.raises(ConnectionClosed):
                connection.recv(timeout=60)
        with closing(Client(server.url)) as client:
            assert client.ask("heartbeat")["message_type"] == "heartbeat_ack"


def test_ten_environments_at_full_size_travel_in_one_message_and_memory_stays_flat(reacher):
    full = (480, 640)
    with serve(reacher) as server, closing(AugustClient(server.url)) as client:
        held = []  # bytes; the process's pages would tell how the allocator keeps what was freed
        tracemalloc.start()
        for step in range(6):
            client.call("update_obs_batch", [seen(index, step, full) for index in range(10)])
            plans = client.call("get_action_batch", list(range(10)))
            assert [len(plan) for plan in plans] == [1] * 10
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert held[-1] - held[1] < 1e6, "a message is 28 MB"


def test_a_call_that_is_sent_again_is_computed_once(reacher):
    expected = alone(reacher, 0, 3)
    with serve(reacher) as server, closing(AugustClient(server.url)) as client:
        for step in range(3):
            client.call("update_obs", seen(0, step), name=f"seen {step}")
            first = client.call("get_action", name=f"act {step}")
            client.reconnect()
            client.step -= 1  # the same request, field by field
            again = client.call("get_action", name=f"act {step}")
            assert np.array_equal(vectors(again), vectors(first))
            assert np.array_equal(vectors(first), expected[step])
        with pytest.raises(RuntimeError, match="give each request its own"):
            client.call("get_action", name="seen 0")


ENCODED = {
    "bytes for a colour": lambda jpeg: {"color": jpeg},
    "numbers": lambda jpeg: {"colors": np.frombuffer(jpeg, np.uint8)},
    "for the camera itself": lambda jpeg: jpeg,
}


@pytest.mark.parametrize("form", ENCODED)
@pytest.mark.parametrize("marked", [False, True])
def test_encoded_colours_give_what_decoded_ones_give(form, marked, reacher):
    picture = np.zeros((16, 24, 3), np.uint8)
    picture[..., 0], picture[..., 2] = 200, 40
    jpeg = marked_jpeg(encode_jpeg(picture[..., ::-1])) if marked else encode_jpeg(picture)
    sent = observation(picture, HOME)
    for camera in sent["vision"]:
        sent["vision"][camera] = ENCODED[form](jpeg)
    shown, _, _ = read_observation(codec.unpack(encode(sent)))
    assert all(np.abs(one.astype(int) - picture).max() < 8 for one in shown.values())
    with serve(reacher) as server, closing(AugustClient(server.url)) as client:
        client.call("update_obs", sent)
        assert len(client.call("get_action")) == 1
        sent["vision"]["cam_head"] = {"color": jpeg[:-20]}
        with pytest.raises(RuntimeError, match="call_failed"):
            client.call("update_obs", sent)


def calibrated(environment, step, size, extrinsics=slice(3)):
    """What an environment shows where each camera is calibrated; (3, 4) of the extrinsics, or all (4, 4)."""
    one, rng = seen(environment, step, size), np.random.default_rng((environment, step))
    for view in one["vision"].values():
        view["color"] = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
        view["intrinsic_matrix"] = np.array([[33.0, 0, size[1] / 2], [0, 33.0, size[0] / 2], [0, 0, 1]])
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]  # (3, 3) orthonormal
        view["extrinsics_matrix"] = np.r_[np.c_[axes, rng.normal(size=3)], [[0, 0, 0, 1]]][extrinsics]
    return one


def shown(policy, one, size):
    """What a policy sees in one of XPolicyLab's observations, without a bridge."""
    views = [one["vision"][CAMERAS[camera]] for camera in policy.cameras]
    images = np.stack([scaled(view["color"], size) for view in views])  # (V, H, W, 3)
    state = np.concatenate([one["state"][part] for part in one["state"] if part.endswith("joint_state")])
    projection = [
        image_projection(view["intrinsic_matrix"], view["extrinsics_matrix"][:3], view["color"].shape[:2])
        for view in views
    ]
    return Sight(images, state, state, np.stack(projection))


def asked_directly(policy, one, size, slot=0):
    """The chunk that a policy gives for one of XPolicyLab's observations in one of its slots, (K, A)."""
    actor, alone = PolicyActor(policy.for_inference()), shown(policy, one, size)
    actor.begin(slot + 1, policy.chunk_length)
    actor.start(slot, 0, alone)
    return actor.act({slot: alone})[slot].actions


@pytest.mark.parametrize("extrinsics", [slice(3), slice(4)], ids=["3x4", "4x4"])
@pytest.mark.parametrize("sent", [(30, 40), (60, 80)], ids=["of the training's size", "larger"])
def test_a_policy_with_keyframes_is_told_the_calibration_and_acts_as_asked_directly(sent, extrinsics, tmp_path):
    policy, size = looking_act(), (30, 40)
    one, other = calibrated(0, 0, sent, extrinsics), calibrated(1, 0, sent, extrinsics)
    expected = [asked_directly(policy, seen, size) for seen in (one, other)]
    plain = {**one, "vision": {name: dict(view) for name, view in one["vision"].items()}}
    for view in plain["vision"].values():
        view["intrinsic_matrix"] = view["intrinsic_matrix"].tolist()  # lists travel as well
        jpeg = encode_jpeg(view["color"])
        view["color"], view["image"] = None, jpeg
    shown = {name: {**view, "color": read_observation(plain)[0][name]} for name, view in one["vision"].items()}
    expected_encoded = asked_directly(policy, {**one, "vision": shown}, size)
    with (
        serve(save(policy, tmp_path / "a.ckpt"), execution="chunk") as server,
        closing(AugustClient(server.url)) as client,
    ):
        client.call("update_obs_batch", [one, {**other, "env_idx": 1}])
        for actions, chunk in zip(client.call("get_action_batch", [0, 1]), expected, strict=True):
            assert np.array_equal(vectors(actions), chunk)
        client.call("reset")
        client.call("update_obs", plain)
        assert np.array_equal(vectors(client.call("get_action")), expected_encoded), "with encoded colours"
    for name, view in one["vision"].items():
        view["extrinsics_matrix"] = other["vision"][name]["extrinsics_matrix"]
    assert not np.array_equal(asked_directly(policy, one, size), expected[0]), "it matters"


def test_who_has_the_second_place_may_ask_first():
    policy, one = looking_act(), calibrated(0, 0, (30, 40), slice(3))
    second = asked_directly(policy, one, (30, 40), slot=1)
    assert np.array_equal(second, asked_directly(policy, one, (30, 40)))


MALFORMED = {
    "missing": ("extrinsics_matrix", None, "nothing"),
    "of another shape": ("extrinsics_matrix", np.eye(3), r"shape \(3, 3\)"),
    "of more axes": ("extrinsics_matrix", np.eye(4)[None], r"shape \(1, 4, 4\)"),
    "flat": ("intrinsic_matrix", [600.0, 600.0, 320.0, 240.0], r"shape \(4,\)"),
    "ragged": ("intrinsic_matrix", [[1.0, 0], [0]], "list"),
    "words": ("intrinsic_matrix", "unknown", "str"),
    "a map": ("intrinsic_matrix", {"fx": 600.0}, "dict"),
    "not finite": ("extrinsics_matrix", np.full((3, 4), np.nan), "NaN"),
    "never filled": ("intrinsic_matrix", np.zeros((3, 3)), "no axes that differ"),
    "transposed": ("extrinsics_matrix", np.eye(4) + np.diag([1.0], -3), "last row"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_calibration_that_cannot_be_used_is_named_and_who_does_not_need_it_does_not_care(case, tmp_path):
    field, value, found = MALFORMED[case]
    shape = r"\(3, 3\)" if field == "intrinsic_matrix" else r"\(3, 4\) or \(4, 4\)"
    one = calibrated(0, 0, (30, 40))
    one["vision"]["cam_left_wrist"][field] = value
    model = XPolicyModel({"checkpoint": str(save(looking_act(), tmp_path / "a.ckpt"))})
    with pytest.raises(ProtocolError, match=rf"^cam_left_wrist/{field}: .*{shape}.*got .*{found}.*keyframes"):
        model.infer(one)
    model.infer(calibrated(0, 1, (30, 40)))
    assert len(XPolicyModel({"checkpoint": str(save(tiny_act(), tmp_path / "b.ckpt"))}).infer(one)) == 1
    one["vision"] = dict.fromkeys(one["vision"], encode_jpeg(np.zeros((30, 40, 3), np.uint8)))
    with pytest.raises(ProtocolError, match=r"^cam_head/intrinsic_matrix: .*got nothing"):
        model.infer(one)  # pictures in the places of the cameras


@pytest.mark.parametrize("name", ["feedback", "__class__", "deployment", "disconnect", "", None, 7])
def test_a_function_that_nobody_knows_is_a_named_error_and_the_connection_lives(name, reacher):
    with serve(reacher) as server, closing(AugustClient(server.url)) as client:
        reply = client.ask("call", {"func_name": name})
        assert reply["payload"]["code"] == "call_failed"
        assert "update_obs" in reply["payload"]["message"]
        assert client.ask("batch_infer")["payload"]["code"] == "unknown_message_type"
        client.call("update_obs", seen(0, 0))
        assert np.array_equal(vectors(client.call("get_action")), alone(reacher, 0, 1)[0])


def test_parallel_workers_of_one_session_do_not_forget_each_others_episodes(reacher):
    """RoboTwin's workers have one session, a connection and a number of the environment each."""
    with (
        serve(reacher) as server,
        closing(AugustClient(server.url)) as one,
        closing(AugustClient(server.url)) as other,
    ):
        expected = {index: alone(reacher, index, 3) for index in (0, 1)}
        for step in range(2):
            for index, client in enumerate((one, other)):
                client.call("update_obs", seen(index, step))
            for index, client in enumerate((one, other)):
                assert np.array_equal(vectors(client.call("get_action")), expected[index][step])
        one.call("reset")
        other.call("update_obs", seen(1, 2))
        assert np.array_equal(vectors(other.call("get_action")), expected[1][2]), "not begun anew"
        one.call("update_obs", seen(0, 0))
        assert np.array_equal(vectors(one.call("get_action")), expected[0][0]), "begun anew"


def test_a_web_page_cannot_connect_and_the_server_is_on_this_machine_only(reacher):
    with serve(reacher) as server:
        assert server.url.startswith("ws://127.0.0.1:")
        with pytest.raises(InvalidStatus), connect(server.url, origin="http://example.org"):
            pass


def test_every_kind_of_request_gets_the_reply_of_its_name(reacher):
    with serve(reacher) as server, closing(Client(server.url)) as client:
        for kind, answer in (("prepare_case", "prepare_case_ack"), ("reset", "reset_result"), ("hello", "hello_ack")):
            assert client.ask(kind)["message_type"] == answer
        assert client.ask("trial_end", {"success": True})["message_type"] == "trial_end_ack"
        reply = client.ask("infer", {"observation": seen(3, 0)}, step=0, repeat_index=7, action_case_id="case")
        assert (reply["repeat_index"], reply["action_case_id"], reply["step"]) == (7, "case", 0)
        assert set(reply) == set(request("infer")), "no other fields"
        assert reply["payload"]["latency_ms"] > 0
        client.connection.send(encode(request("close")))
        with pytest.raises(ConnectionClosed):
            client.connection.recv(timeout=60)


def test_replies_tell_of_an_alarm_from_its_step_to_the_end_of_the_episode(reacher, tmp_path, caplog):
    file = tmp_path / "policy_best.ckpt"
    file.write_bytes(reacher.read_bytes())
    write_alarms(file, [Alarm(sha256(file), "2", "reach", "demo_clean", "hash", 40, 0.1, threshold=9.0, steps=3)])
    with (
        serve(file, execution=2) as server,
        closing(Client(server.url)) as client,
        closing(AugustClient(server.url, trial="another")) as other,
    ):
        told = [client.ask("infer", {"observation": seen(3, step)}, step=step)["payload"] for step in range(4)]
        assert [reply.get("alarms") for reply in told] == [None, None, {"3": 4}, {"3": 4}]
        again = client.ask("call", {"func_name": "get_action", "obs": seen(3, 9)})["payload"]
        assert again["alarms"] == {"3": 4}
        assert len(again["result"]) == 2
        assert "alarms" not in other.ask("call", {"func_name": "infer", "obs": seen(0, 0)})["payload"]
        assert "alarms" not in client.ask("reset")["payload"]
    assert caplog.text.count("alarm in environment") == 1


def test_a_failure_inside_the_policy_is_told_without_its_traceback(reacher, monkeypatch, caplog):
    with serve(reacher) as server, closing(Client(server.url)) as client:
        monkeypatch.setattr(server.model.deployment, "act", lambda seen: 1 / 0)
        reply = client.ask("infer", {"observation": seen(0, 0)})
    assert reply["payload"]["code"] == "infer_failed"
    assert "ZeroDivisionError" not in str(reply)
    assert "ZeroDivisionError" in caplog.text, "the log of the server has it"


def test_a_port_that_is_taken_is_an_error_that_says_so(reacher):
    with serve(reacher) as server, pytest.raises(ConfigError, match=str(server.port)):
        asyncio.run(PolicyServer(server.model, port=server.port).serve(print))


def test_a_resent_request_moves_nothing_on(reacher):
    model, expected = XPolicyModel({"checkpoint": str(reacher)}), alone(reacher, 0, 3)
    for step in range(3):
        for request_name in (f"{step}", f"{step}", None, "another name after a reconnect"):
            actions = model.infer(seen(0, step), step=step, request=request_name)
            assert np.array_equal(vectors(actions), expected[step])
    with pytest.raises(ProtocolError, match="step 2 or later"):
        model.infer(seen(0, 1), step=1)
    model.reset()
    model.update_obs(seen(0, 0))
    direct = model.get_action()
    assert np.array_equal(vectors(direct), expected[0])
    assert model.get_action() is direct, "asked again without a new observation"
    model.update_obs(seen(0, 0))
    model.update_obs(seen(0, 1))
    assert np.array_equal(vectors(model.get_action()), expected[1]), "an observation nobody asked about is no step"


def test_a_client_that_does_not_count_its_steps_still_moves_on(reacher):
    model, expected = XPolicyModel({"checkpoint": str(reacher)}), alone(reacher, 0, 4)
    for step in range(4):
        assert np.array_equal(vectors(model.infer(seen(0, step), step=0, request=str(step))), expected[step])


def test_batched_calls_give_what_single_ones_give_in_the_order_asked_for(reacher):
    model = XPolicyModel({"checkpoint": str(reacher), "execution": 3})
    expected = {index: alone(reacher, index, 2, 3) for index in (4, 0, 7)}
    for step in range(2):
        model.update_obs_batch([seen(index, step) for index in (4, 0, 7)])
        for order in ((7, 4, 0), (0,), (4, 0, 7)):
            for index, actions in zip(order, model.get_action_batch(order), strict=True):
                assert len(actions) == 3
                assert np.array_equal(vectors(actions), expected[index][step])
    with pytest.raises(ProtocolError, match="update_obs"):
        model.get_action_batch([4, 5])
    with pytest.raises(ProtocolError, match="update_obs"):
        XPolicyModel({"checkpoint": str(reacher)}).get_action()


def test_a_reset_forgets_the_environments_of_its_own_client_only(reacher):
    model, expected = XPolicyModel({"checkpoint": str(reacher)}), alone(reacher, 0, 3)
    for client in ("one", "two"):
        for step in range(2):
            model.infer(seen(0, step), session=client, step=step)
    model.reset(session="one")
    assert np.array_equal(vectors(model.infer(seen(0, 0), session="one", step=0)), expected[0])
    assert np.array_equal(vectors(model.infer(seen(0, 2), session="two", step=2)), expected[2])
    model.reset({"scene": 3})  # as the older protocol calls it
    assert np.array_equal(vectors(model.infer(seen(0, 0))), expected[0])


def test_an_episode_whose_beginning_is_not_known_is_refused_and_not_begun_anew(reacher):
    model = XPolicyModel({"checkpoint": str(reacher), "environments": 2})
    with pytest.raises(ProtocolError, match="Reset"):
        model.infer(seen(0, 3), step=3)  # the server was restarted
    for index in range(3):
        model.infer(seen(index, 0), step=0)
    with pytest.raises(ProtocolError, match="environment 0"):
        model.infer(seen(0, 1), step=1)  # its place has been taken
    assert np.array_equal(vectors(model.infer(seen(2, 1), step=1)), alone(reacher, 2, 2)[1])
    with pytest.raises(ConfigError, match="environments"):
        model.update_obs_batch([seen(index, 0) for index in range(3)])


def test_a_single_arm_has_names_without_a_side(tmp_path):
    policy, ones = tiny_act(cameras=("cam_high",), state_dim=7, action_dim=7, fitted=False), torch.ones(7)
    policy.set_statistics(Statistics(*[0 * ones, ones, -ones, ones] * 2))
    model = XPolicyModel({"checkpoint": str(save(policy, tmp_path / "a.ckpt"))})
    both = seen(0, 0)
    for arm in ("arm_joint_state", "joint_state"):
        single = {**both, "state": {arm: np.zeros(6, np.float32), "ee_joint_state": np.zeros(1, np.float32)}}
        actions = model.infer(single)
        assert list(actions[0]) == [arm, "ee_joint_state"]
        assert actions[0][arm].shape == (6,)
    with pytest.raises(ProtocolError, match="7 numbers"):
        model.infer(both)


def test_arrays_and_scalars_survive_the_way_and_nothing_else_is_an_array():
    rng = np.random.default_rng(0)
    arrays = [rng.integers(0, 256, (2, 3, 3), dtype=np.uint8), rng.normal(size=5).astype(">f8"), np.zeros((0, 2), bool)]
    message = {"arrays": arrays, "scalar": np.float32(1.5), "text": "é", "nothing": None, "nested": [{"a": [1, 2]}]}
    for frame in (codec.pack(message), msgpack.packb(message, default=array_to_map)):
        found = codec.unpack(frame)
        for ours, theirs in zip(found["arrays"], arrays, strict=True):
            assert ours.dtype == theirs.dtype
            assert np.array_equal(ours, theirs)
        assert found["scalar"] == 1.5
        assert found["nested"] == [{"a": [1, 2]}]
    for value in (np.array([object()]), np.array(["a"]), object()):
        with pytest.raises(TypeError):
            codec.pack({"value": value})


def test_a_checkpoint_is_found_by_xpolicylabs_name_of_a_run(reacher, tmp_path):
    run = {"bench_name": "RoboTwin", "ckpt_name": "first", "env_cfg_type": "arx_x5", "action_type": "joint", "seed": 0}
    with pytest.raises(CheckpointError, match="RoboTwin-first-arx_x5-joint-0"):
        find_checkpoint(run, tmp_path)
    for folder in ("first", "RoboTwin-first-arx_x5-joint-0"):
        place = tmp_path / "checkpoints" / folder / "policy_best.ckpt"
        place.parent.mkdir(parents=True)
        place.write_bytes(reacher.read_bytes())
        assert find_checkpoint(run, tmp_path) == place
    assert XPolicyModel(run, tmp_path).infer(seen(0, 0))
    with pytest.raises(ConfigError, match="joint"):
        XPolicyModel({**run, "action_type": "ee"}, tmp_path)


def test_the_scripts_are_valid_say_how_to_call_them_and_start_the_server(reacher, tmp_path):
    folder = tmp_path / "XPolicyLab" / "policy" / "UGR"
    write_adapter(reacher, folder)
    names = {"README.md", "__init__.py", "install.sh", "process_data.sh", "train.sh", "eval.sh", "deploy.yml"}
    names |= {"setup_eval_policy_server.sh", "setup_eval_env_client.sh", "deploy.py", "model.py"}
    assert {path.name for path in folder.iterdir()} == names
    for script in folder.glob("*.sh"):
        assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
        if script.name != "process_data.sh":
            called = subprocess.run(["bash", script], capture_output=True, text=True, check=False)
            assert called.returncode == 2
            assert script.name in called.stderr
    (tmp_path / "venv" / "bin").mkdir(parents=True)
    ugr = tmp_path / "venv" / "bin" / "ugr"
    ugr.write_text('#!/bin/bash\necho "$@"\n')
    ugr.chmod(0o755)
    arguments = ["RoboTwin", "click", "first", "arx_x5", "joint", "0", "0", str(tmp_path / "venv"), "5000"]
    command = ["bash", folder / "setup_eval_policy_server.sh", *arguments]
    called = subprocess.run(command, capture_output=True, text=True, check=True)
    assert called.stdout.startswith(f"bridge serve --folder {folder} --bench_name RoboTwin --task_name click")
    assert called.stdout.endswith("--seed 0 --port 5000 --host localhost\n")


def test_without_the_extra_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "msgpack", None)
    with pytest.raises(ConfigError, match=r"ugr-lightning\[xpolicylab\]"):
        PolicyServer(types.SimpleNamespace())


def test_the_environments_side_needs_nothing_of_ours(adapter, reacher):
    adapter(reacher)
    program = "import sys; sys.path.insert(0, sys.argv[1]); import XPolicyLab.policy.UGR.deploy; print(*sys.modules)"
    root = Path(importlib.import_module("XPolicyLab").__file__).parents[1]
    called = subprocess.run([sys.executable, "-c", program, root], capture_output=True, text=True, check=True)
    assert "ugr_lightning" not in called.stdout.replace("__editable__", "")
    assert "torch" not in called.stdout.split()
