import hashlib
import os
import signal
from functools import partial

import numpy as np
import pytest
import torch
from fake_policy import Reacher
from fake_simulator import HOME, FakeSimulator

from ugr_lightning.contract import CAMERAS, Observation
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.results.results import read_results
from ugr_lightning.rollout.actors import ROWS, Actor, Decision, PolicyActor
from ugr_lightning.rollout.aggregation import make_execution
from ugr_lightning.rollout.evaluate import make_actor, run_episodes
from ugr_lightning.rollout.simulators import Simulators
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.sim.seeds import seeds_hash

pytestmark = pytest.mark.usefixtures("fake_tasks")

SEEDS = [9, 0, 1, 2, 3, 4]
PROBES = ROWS
"""Queries that find out at which sizes of a batch the bits are the same."""


def run(actor, seeds=SEEDS, task="reach", *, simulators=None, on_result=None, **more):
    small = {"image_size": (24, 32), "progress": False, "workers": 1, "slots_per_worker": 2}
    return run_episodes(actor, RolloutSpec(task, seeds, **small | more), simulators=simulators, on_result=on_result)


@pytest.fixture(scope="module")
def runner(fake_tasks):
    """`run` in two processes that stay."""
    with Simulators() as opened:
        yield partial(run, simulators=opened, workers=2)


def outcome(results):
    return [(result.seed, result.success, result.steps, result.log_variance, result.crash) for result in results]


@pytest.mark.parametrize("execution", ["aggregate", 3, "5"])
def test_a_policy_is_judged_seed_by_seed(runner, execution):
    policy = Reacher()
    policy.refine = Uncertainty()
    results = runner(PolicyActor(policy, checkpoint="abc", refine_ratio=0.2), SEEDS, execution=execution)
    assert [result.seed for result in results] == SEEDS
    assert all(result.success and result.first_success_step == result.steps for result in results)
    first = results[0]
    assert (first.policy, first.execution, first.checkpoint) == ("Reacher", str(execution), "abc")
    assert first.seeds_hash == seeds_hash(SEEDS)
    assert first.log_variance == {"mean": -3.0, "max": -1.0}
    assert set(first.seconds) == {"query", "simulate"}
    assert (first.refine, first.refine_ratio) == ("Uncertainty", 0.2)
    assert PolicyActor(Reacher()).refine is None
    every = 1 if execution == "aggregate" else int(execution)
    assert first.queries == -(-first.steps // every)


def test_what_the_expert_could_not_reach_is_told(capsys):
    results = run("expert", [2, 3], task="out_of_reach")
    assert [(result.success, result.crash) for result in results] == [(True, None), (False, None)]
    assert "Seed 3: left arm, phase `reach`: expected a tool pose within its reach" in capsys.readouterr().err


def test_the_dummies_run_through_the_same_runner(runner):
    zero = runner("zero", SEEDS)
    assert [(result.success, result.steps) for result in zero] == [(False, FakeSimulator.horizon)] * len(SEEDS)
    expert = runner("expert", SEEDS)
    assert [result.success for result in expert] == [seed % 5 != 3 for seed in SEEDS]
    once, again = {}, {}
    for traces in (once, again):
        runner("random", SEEDS[:2], on_result=lambda result, trace, kept=traces: kept.update({result.seed: trace}))
    assert all(np.array_equal(once[seed].actions, again[seed].actions) for seed in SEEDS[:2])
    assert np.abs(np.diff(np.stack(once[9].actions), axis=0)).max() > 0.1


def test_results_depend_on_the_seeds_and_not_on_slots_or_history(runner):
    many = outcome(runner(Reacher(), SEEDS))
    assert outcome(runner(Reacher(), SEEDS)) == many
    alone = outcome(run(Reacher(), workers=1, slots_per_worker=1))
    backwards = outcome(runner(Reacher(), SEEDS[::-1]))
    assert alone == backwards[::-1] == many


def test_the_motion_hash_tells_episodes_apart_and_knows_a_repetition(runner):
    first, other = (runner("random", [seed])[0].motion_hash for seed in (7, 8))
    assert first == runner("random", [7])[0].motion_hash
    assert first != other


def test_queries_have_a_row_for_each_slot_that_asks_as_uint8_without_a_copy_to_channels_first(runner):
    policy = Reacher()
    policy.train()
    runner(policy, SEEDS)
    assert set(policy.batch_sizes[PROBES:]) <= set(range(1, ROWS + 1))
    assert 2 * len(policy.batch_sizes[PROBES:]) < sum(policy.batch_sizes[PROBES:]), "slots ask together"
    assert {(shape[1:], *rest) for shape, *rest in policy.layouts} == {((3, 3, 24, 32), torch.uint8, True)}
    assert set(policy.modes) == {False}
    assert policy.training


class Rounding(Reacher):
    """Its last bits depend on the number of rows, as those of a matrix product may."""

    def predict(self, observation):
        chunk = super().predict(observation)
        return chunk._replace(actions=chunk.actions + 1e-6 * len(observation.images))


def test_where_rounding_depends_on_the_batch_all_queries_have_one_size_whatever_the_slots():
    motions = []
    for workers, slots in ((1, 1), (1, 6), (2, 2)):
        policy = Rounding()
        results = run(policy, workers=workers, slots_per_worker=slots)
        motions.append([result.motion_hash for result in results])
        assert set(policy.batch_sizes[PROBES:]) == {ROWS}
    assert motions[0] == motions[1] == motions[2]


class Watching(PolicyActor):
    """Remembers for each decision how many steps it is for."""

    def begin(self, slots, execution):
        super().begin(slots, execution)
        self.steps = []

    def act(self, frames):
        decisions = super().act(frames)
        self.steps += [len(decision.actions) for decision in decisions.values()]
        return decisions


def test_pictures_are_taken_only_for_queries_and_videos(tmp_path):
    for policy, observations, expected in ((Reacher(), 1, [3]), (Remembering(), 2, [2, 1])):
        policy.observation_steps = observations
        actor = Watching(policy)
        steps = run(actor, [5], execution=3)[0].steps
        assert actor.steps == (expected * 7)[: len(actor.steps)]
        assert sum(actor.steps) - steps < 3, "nobody decides for an episode that has ended"
    traces = []
    run(actor, [5], execution=3, videos={5: tmp_path / "a.gif"}, on_result=lambda result, trace: traces.append(trace))
    assert {len(images) for images in traces[0].images} == {3}


class Sighted(Reacher):
    """Sees the right hand's next grip in the corner of each of its pictures, 2 m ahead of the first camera."""

    def predict(self, observation):
        chunk = super().predict(observation)
        rows = len(chunk.actions)
        maps = torch.zeros(rows, len(self.cameras), 2, 2, 6, 8)
        maps[:, :, 1, 0, 0, 0] = 0.5
        return chunk._replace(maps=maps, points=torch.tensor([0.0, 0, 2]).expand(rows, 2, 2, 3))


def test_a_film_shows_where_the_policy_sees_keyframes_in_the_cameras_that_it_looks_through(tmp_path):
    films, traces = [], []
    for policy in (Reacher(cameras=CAMERAS[2:]), Sighted(cameras=CAMERAS[2:])):
        path = tmp_path / f"{len(films)}.gif"
        run(policy, [1], execution=4, videos={1: path}, on_result=lambda result, trace: traces.append(trace))
        films.append(traces[-1].video())
    blind, sighted = films
    assert not np.array_equal(blind[0, :6, 64:68], sighted[0, :6, 64:68])  # the glow is in the third camera
    assert np.array_equal(blind[0, 18:], sighted[0, 18:])  # away from the pins in the middle and from the glow
    assert [step for step, maps in enumerate(traces[1].maps) if maps is not None][:2] == [0, 4]
    assert traces[1].maps[0][:2].max() == 0
    assert not np.array_equal(blind[1, 10:14, 14:18], sighted[1, 10:14, 14:18])  # a pin stays between queries
    run(Sighted(), [1], execution=4, on_result=lambda result, trace: traces.append(trace))
    assert traces[-1].maps == []


def test_simulators_stay_open_between_calls_where_they_are_kept():
    with Simulators() as kept:
        pids = []
        for execution in ("aggregate", 5):
            assert all(result.success for result in run(Reacher(), execution=execution, simulators=kept))
            (crew,) = kept._opened.values()
            pids += [worker.pid for worker in crew.workers]
        assert pids[0] == pids[1]
    assert crew.workers[0].pid is None


def alone_and_step_by_step(policy, seed, execution):
    """The measured joints of an episode in a simulator of this process: look, decide, step."""
    simulator = FakeSimulator("reach", image_size=(24, 32))
    chunks = make_execution(execution, policy.chunk_length)
    frame = simulator.reset(seed)
    seen, joints = [frame] * policy.observation_steps, [frame.measured]
    while not frame.success and len(joints) <= simulator.horizon:
        if chunks.needs_query(0):
            images = torch.from_numpy(np.stack([one.images for one in seen])).movedim(-1, -3)  # (T, V, 3, H, W)
            state = torch.from_numpy(np.stack([one.commanded for one in seen]))  # (T, S)
            several = policy.observation_steps > 1
            chunk = policy.predict(Observation(images[None] if several else images, state[None] if several else state))
            chunks.push(0, chunk.actions[0].numpy())
        frame = simulator.step(chunks.next(0))
        seen, joints = [*seen[1:], frame], [*joints, frame.measured]
    return hashlib.sha256(b"".join(one.tobytes() for one in joints)).hexdigest()


@pytest.mark.parametrize("execution", ["aggregate", 2, 5])
@pytest.mark.parametrize("observations", [1, 3])
def test_an_episode_goes_as_it_does_alone_and_step_by_step_bit_for_bit(runner, execution, observations):
    policy = Reacher() if observations == 1 else Remembering()
    policy.observation_steps = observations
    expected = [alone_and_step_by_step(policy, seed, execution) for seed in SEEDS]
    assert [result.motion_hash for result in runner(policy, execution=execution)] == expected


class Colours(Reacher):
    def predict(self, observation):
        self.seen = observation.images[:, :, :, -1, -1].argmax(dim=2)  # (B, V): the fake paints view v in colour v
        return super().predict(observation)


def test_cameras_are_found_by_name(runner):
    policy = Colours(cameras=(CAMERAS[2], CAMERAS[0]))
    runner(policy, [0])
    assert policy.seen[0].tolist() == [2, 0]


def test_a_policy_of_another_robot_is_refused_in_one_sentence_before_any_process_starts(monkeypatch):
    monkeypatch.setattr(Simulators, "open", lambda *_: pytest.fail("a process starts"))
    strange = Reacher()
    strange.action_dim = 16
    for policy, task, got in (
        (Reacher(cameras=("cam_high", "cam_front")), "reach", "cameras cam_high, cam_front"),
        (strange, "reach", "got state 14, action 16"),
        (Reacher(cameras=("top",)), "one_arm", "state 7, action 7, cameras among top.*got state 14, action 14"),
    ):
        for actor in (policy, PolicyActor(policy, cameras=(*CAMERAS, "cam_front", "top"))):
            with pytest.raises(CheckpointError, match=got):
                run(actor, task=task)


@pytest.mark.parametrize(("task", "grippers"), [("one_arm", [6]), ("two_long_arms", [7, 15])])
def test_a_robot_of_other_joints_is_moved_by_dummies(task, grippers):
    assert [result.success for result in run("expert", [0, 1], task)] == [True, True]
    traces = []
    run("random", [0], task, on_result=lambda result, trace: traces.append(trace))
    poses = np.stack(traces[0].actions)
    assert poses.shape == (FakeSimulator.horizon, grippers[-1] + 1)
    opening, moved = poses[:, grippers], np.delete(poses - np.resize(HOME, poses.shape[1]), grippers, axis=1)
    assert ((opening >= 0) & (opening <= 1)).all()
    assert (np.abs(moved) <= 0.5).all()


def test_a_robot_of_seven_joints_is_moved_by_a_policy_of_its_own():
    assert all(result.success for result in run(OneArmed(), [0, 1], "one_arm"))


class OneArmed(Reacher):
    def __init__(self):
        super().__init__(cameras=("top",))
        self.state_dim = self.action_dim = 7

    def predict(self, observation):
        chunk = super().predict(observation)
        return chunk._replace(actions=chunk.actions[..., :7])


def test_data_of_another_rate_than_the_simulators_are_said():
    slow = PolicyActor(Reacher(), control_hz=50.0)
    with pytest.warns(UserWarning, match="50 actions a second and reach takes 25: it moves 0.5 times as fast"):
        run(slow, [0])


def test_a_simulator_with_cameras_of_its_own_decides_which_are_known():
    assert PolicyActor(Reacher(cameras=("top",)), cameras=("side", "top"))._views == [1]
    with pytest.raises(CheckpointError, match="cameras among top, got cam_high"):
        PolicyActor(Reacher(cameras=("cam_high",)), cameras=("top",))


@pytest.mark.parametrize("state", ["commanded", "measured"])
def test_a_policy_sees_the_joints_it_was_trained_on(runner, state):
    policy, traces = Reacher(), []
    runner(PolicyActor(policy, state=state), [0], on_result=lambda result, trace: traces.append(trace))
    seen = torch.stack([states[0] for states in policy.states[PROBES:]]).numpy()
    frames = traces[0].frames[:-1]
    assert np.array_equal(seen, np.stack([getattr(frame, state) for frame in frames]))
    assert not np.array_equal(frames[-1].commanded, frames[-1].measured)


class Remembering(Reacher):
    """Acts on the newest of its observations and keeps all states and one pixel of each picture."""

    def predict(self, observation):
        images, state, _ = observation
        self.pixels = [
            *getattr(self, "pixels", []),
            images[:, :, 0, 0, -1, -1].clone(),
        ]  # (B, T): the fake counts steps there
        self.histories = [*getattr(self, "histories", []), state.clone()]  # (B, T, S)
        return super().predict(type(observation)(images[:, -1], state[:, -1]))


def test_a_policy_of_several_observations_sees_the_steps_just_before_also_those_without_a_query():
    policy, traces = Remembering(chunk_length=6), []
    policy.observation_steps = 3
    keep = {"on_result": lambda result, trace: traces.append(trace)}
    results = run(policy, seeds=[5, 6], workers=1, slots_per_worker=1, execution=4, **keep)
    seen = iter(zip(policy.histories[PROBES:], policy.pixels[PROBES:], strict=True))
    for result, trace in zip(results, traces, strict=True):
        for step in range(0, result.steps, 4):
            past = [max(0, step - 2), max(0, step - 1), step]  # before the start: the first, never the last episode
            history, pixels = next(seen)
            assert np.array_equal(history[0].numpy(), np.stack([trace.frames[i].commanded for i in past]))
            assert pixels[0].tolist() == past
    assert next(seen, None) is None
    assert len(policy.histories) > 3


def test_nan_never_reaches_the_simulator_and_names_step_and_seed():
    results = run(Reacher(broken=0.47), seeds=[0, 4, 1])  # the goal of seed 4 lies above
    assert [result.success for result in results] == [True, False, True]
    assert "step 0 of seed 4" in results[1].crash


def test_a_nan_later_in_the_episode_is_caught_at_its_step(runner):
    class Late(Actor):
        name = "late"

        def start(self, slot, seed, frame):
            self.steps = 0

        def act(self, frames):
            self.steps += 1
            value = np.inf if self.steps == 2 else 0.0
            return {slot: Decision(np.full((2, 14), [[0.0], [value]], np.float32)) for slot in frames}

    result = runner(Late(), [5])[0]
    assert (result.success, result.steps) == (False, 3)
    assert "action at step 3 of seed 5" in result.crash


@pytest.mark.parametrize(
    ("task", "slots", "message"),
    [
        ("deadly", 1, "SIGKILL"),
        ("deadly", 2, "SIGKILL"),
        ("hang", 2, "did not answer within 5 s"),
        ("faulty", 2, "ValueError: the scene fell over"),
    ],
)
def test_a_crash_costs_its_own_episode_only(task, slots, message):
    results = run("expert", seeds=[0, 1, 2, 4, 5], task=task, workers=2 // slots, slots_per_worker=slots, timeout_s=5)
    assert [result.success for result in results] == [True, True, False, True, True]
    assert message in results[2].crash
    assert [result.crash for result in results if result.seed != 2] == [None] * 4
    healthy = run("expert", seeds=[0, 1, 4, 5])
    assert [result.motion_hash for result in results if result.seed != 2] == [one.motion_hash for one in healthy]


def test_results_arrive_as_they_come_with_their_trace_and_video(runner, tmp_path):
    arrived = []
    results = runner(
        Reacher(),
        [0, 1, 2],
        videos={1: tmp_path / "one.gif"},
        on_result=lambda result, trace: arrived.append((result, trace)),
    )
    assert [path.name for path in tmp_path.iterdir()] == ["one.gif"]
    assert [result.video for result in results] == [None, str(tmp_path / "one.gif"), None]
    assert {result.seed for result, _ in arrived} == {0, 1, 2}
    for result, trace in arrived:
        assert len(trace.frames) == result.steps + 1 == len(trace.actions) + 1 == len(trace.log_variance) + 1
        assert bool(trace.images) == (result.seed == 1)


def test_simulators_do_not_render_for_those_who_do_not_look():
    shapes = []

    class Blind(Actor):
        name = "blind"

        def start(self, slot, seed, frame):
            shapes.append(frame.images.shape)

        def act(self, frames):
            return {slot: Decision(frame.commanded[None]) for slot, frame in frames.items()}

    run(Blind(), seeds=[0])
    assert shapes == [(0, 24, 32, 3)]


def test_an_unknown_actor_or_execution_is_an_error(runner):
    with pytest.raises(ConfigError, match="zero, random, expert"):
        make_actor("exprt", "reach")
    with pytest.raises(ConfigError, match="execution"):
        runner(Reacher(), [0], execution="aggregated")


def test_results_say_the_setting_that_the_episodes_ran_in():
    assert [result.setting for result in run("zero", [1, 2], setting="demo_randomized")] == ["demo_randomized"] * 2


def test_episodes_of_other_pictures_are_other_episodes(tmp_path):
    out = tmp_path / "results.jsonl"
    for size in ((24, 32), (24, 32), (12, 16)):
        run(PolicyActor(Reacher()), [1], out=out, resume=True, image_size=size)
    assert [result.image_size for result in read_results(out)] == [[24, 32], [12, 16]]


def test_a_video_of_an_unknown_kind_and_nothing_to_run_are_refused_at_once(tmp_path):
    with pytest.raises(ConfigError, match=r"ending in \.gif or \.mp4"):
        RolloutSpec("reach", [0], videos={0: tmp_path / "a.avi"})
    with pytest.raises(ConfigError, match="at least one seed"):
        RolloutSpec("reach", [])


class Assassin(Reacher):
    """Kills a process once, while all of them simulate."""

    def predict(self, observation):
        if len(self.batch_sizes) == PROBES + 3:
            os.kill(self.victim.pid, signal.SIGKILL)
        return super().predict(observation)


def test_a_process_that_dies_between_two_messages_costs_one_episode():
    with Simulators() as kept:
        options = {"simulators": kept, "workers": 2, "seeds": [9, 0, 1, 2, 4, 5]}
        undisturbed = run(Reacher(), **options)
        policy = Assassin()
        policy.victim = next(iter(kept._opened.values())).workers[1]
        results = run(policy, **options)
    assert [result.seed for result in results if result.crash] != []
    assert sum(result.crash is not None for result in results) == 1
    for result, healthy in zip(results, undisturbed, strict=True):
        assert result.crash or result.motion_hash == healthy.motion_hash
