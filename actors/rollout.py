"""One episode as a ticket asks for it: the loop in which a policy meets an environment."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.envs import ClothbusEnv
from broker_config.messages import Mark, Ticket, Trajectory, TrajectoryId

if TYPE_CHECKING:
    from actors.robot.motion import JointPath  # brings numba, which only robots need

Observation = NDArray[np.uint8]
"""u8[H, W, C]."""


class ActingPolicy(Protocol):
    """Whatever chooses actions: a network, a script, chance."""

    def act(self, observation: Observation, generator: np.random.Generator, epsilon: float) -> int:
        """The index of the action for this picture; random numbers come from `generator` only."""


@dataclass(frozen=True)
class Start:
    """The episode's first picture."""

    observation: Observation


@dataclass(frozen=True)
class Step:
    """One transition, without the picture that it started from."""

    action: int
    reward: float
    observation: Observation
    terminated: bool
    truncated: bool
    success: bool
    guard: str | None
    marks: tuple[Mark, ...] = ()
    """Where the action picked, dropped and folded, in pixels of the picture."""
    motion: JointPath | None = None
    """How the robot moved for it, if one did."""


def rollout(
    env: ClothbusEnv,
    policy: ActingPolicy,
    ticket: Ticket,
    reset_options: Mapping[str, Any] | None = None,
) -> Iterator[Start | Step]:
    """Plays an episode and yields it as it happens.

    Environment and policy are seeded from the ticket alone, so that an episode of a deterministic
    environment is the same whoever plays it. The caller may stop between any two steps.
    """
    _, policy_seed = np.random.SeedSequence(ticket.seed).spawn(2)
    generator = np.random.default_rng(policy_seed)
    options = None if reset_options is None else dict(reset_options)
    observation, _ = env.reset(seed=environment_seed(ticket), options=options)
    yield Start(observation)
    for _ in range(ticket.steps):
        action = policy.act(observation, generator, ticket.epsilon)
        observation, reward, terminated, truncated, info = env.step(action)
        yield _step(action, float(reward), observation, terminated, truncated, info)
        if terminated or truncated:
            return


def environment_seed(ticket: Ticket) -> int:
    """With which `reset` begins the ticket's episode."""
    env_seed, _ = np.random.SeedSequence(ticket.seed).spawn(2)
    return int(env_seed.generate_state(1)[0])


def _step(
    action: int,
    reward: float,
    observation: Observation,
    terminated: bool,
    truncated: bool,
    info: dict[str, Any],
) -> Step:
    guard = info.get("guard")
    return Step(
        action,
        reward,
        observation,
        bool(terminated),
        bool(truncated),
        bool(info.get("success", False)),
        None if guard is None else str(guard),
        info.get("marks", ()),
        info.get("motion"),
    )


def to_trajectory(id_: TrajectoryId, ticket: Ticket, start: Start, steps: list[Step]) -> Trajectory:
    """Joins the parts of a finished episode into the message that is published."""
    last = steps[-1]
    return Trajectory(
        id=id_,
        ticket=ticket,
        observations=np.stack([start.observation, *(step.observation for step in steps)]),
        actions=np.array([step.action for step in steps], np.int32),
        rewards=np.array([step.reward for step in steps], np.float32),
        terminated=last.terminated,
        truncated=not last.terminated,
        success=last.success,
        guard=last.guard,
        interrupted=False,
        ended_unix_secs=time.time(),
    )


def collect(
    env: ClothbusEnv,
    policy: ActingPolicy,
    ticket: Ticket,
    id_: TrajectoryId,
    on_step: Callable[[], None] = lambda: None,
    reset_options: Mapping[str, Any] | None = None,
) -> Trajectory:
    """Plays a whole episode; whatever `on_step` raises after a step ends it."""
    events = rollout(env, policy, ticket, reset_options)
    start = next(events)
    assert isinstance(start, Start)
    steps: list[Step] = []
    for step in events:
        assert isinstance(step, Step)
        steps.append(step)
        on_step()
    return to_trajectory(id_, ticket, start, steps)
