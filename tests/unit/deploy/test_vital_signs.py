"""Who is blamed for silence, on a clock that the test turns."""

from __future__ import annotations

from broker_config.keys import parse_key
from broker_config.messages import Heartbeat, Role
from deploy.running.vital_signs import START_SECS, Living, VitalSigns

HUNG = 60.0
OWNER, ROUTER, ONE, TWO = 1, 2, 3, 4
IDS: dict[int, tuple[Role, str]] = {
    OWNER: ("owner", "learner"),
    ROUTER: ("router", "router"),
    ONE: ("actor", "one"),
    TWO: ("actor", "two"),
}


class Scene:
    """A run whose processes beat as the test says; `pass_secs` judges twice a second."""

    def __init__(self, *pids: int) -> None:
        self.now_secs = 1000.0
        self.signs = VitalSigns(HUNG, lambda: self.now_secs)
        self.living = {pid: Living(*IDS[pid], pid, self.now_secs) for pid in pids}
        self.stalled_secs: dict[int, float] = {}

    def beat(self, pid: int) -> None:
        role, name = IDS[pid]
        stalled_secs = self.stalled_secs.get(pid, 0.0)
        heartbeat = Heartbeat(role, name, "life", "host", pid, "acting", stalled_secs, {})
        self.signs.on_heartbeat(parse_key(f"run/live/{role}/{name}"), heartbeat)

    def judge(self) -> set[str]:
        return {it.process.id for it in self.signs.judge(list(self.living.values()))}

    def pass_secs(self, secs: float, *beating: int) -> set[str]:
        """Lets time pass; returns whoever is blamed first."""
        for _ in range(int(2 * secs)):
            self.now_secs += 0.5
            for pid in beating:
                self.beat(pid)
            if blamed := self.judge():
                return blamed
        return set()

    def restart(self, pid: int) -> None:
        self.living[pid] = Living(*IDS[pid], pid, self.now_secs)


def test_nobody_is_blamed_while_all_beat() -> None:
    scene = Scene(OWNER, ROUTER, ONE, TWO)
    assert scene.pass_secs(300, OWNER, ONE, TWO) == set()


def test_a_silent_process_is_blamed_after_its_time_and_not_before() -> None:
    scene = Scene(OWNER, ROUTER, ONE, TWO)
    scene.pass_secs(10, OWNER, ONE, TWO)
    assert scene.pass_secs(HUNG, OWNER, ONE) == set()
    assert scene.pass_secs(1, OWNER, ONE) == {"two"}


def test_a_new_process_has_time_to_start() -> None:
    scene = Scene(OWNER, ROUTER, ONE)
    scene.pass_secs(10, OWNER, ONE)
    scene.living[TWO] = Living(*IDS[TWO], TWO, scene.now_secs)
    assert scene.pass_secs(START_SECS, OWNER, ONE) == set()
    assert scene.pass_secs(1, OWNER, ONE) == {"two"}


def test_actors_that_no_owner_has_welcomed_are_not_blamed() -> None:
    scene = Scene(OWNER, ROUTER, ONE, TWO)
    scene.pass_secs(10, ONE)
    assert scene.pass_secs(50, ONE) == set()
    assert scene.pass_secs(10, ONE) == {"learner"}


def test_when_nobody_is_heard_the_router_is_blamed_and_then_everybody() -> None:
    scene = Scene(OWNER, ROUTER, ONE, TWO)
    scene.pass_secs(10, OWNER, ONE, TWO)
    assert scene.pass_secs(HUNG) == set()
    assert scene.pass_secs(1) == {"router"}
    scene.restart(ROUTER)
    assert scene.pass_secs(HUNG) == set()
    assert scene.pass_secs(1) == {"learner", "one", "two"}


def test_a_router_that_helped_is_blamed_again_the_next_time() -> None:
    scene = Scene(OWNER, ROUTER, ONE)
    for _ in range(2):
        scene.pass_secs(10, OWNER, ONE)
        assert scene.pass_secs(HUNG + 1) == {"router"}
        scene.restart(ROUTER)


def test_without_a_router_of_ours_nobody_is_blamed_for_general_silence() -> None:
    scene = Scene(OWNER, ONE, TWO)
    scene.pass_secs(10, OWNER, ONE, TWO)
    assert scene.pass_secs(5 * HUNG) == set()


def test_whoever_judges_after_having_been_stopped_gives_everybody_a_fresh_chance() -> None:
    scene = Scene(OWNER, ROUTER, ONE)
    scene.pass_secs(10, OWNER, ONE)
    scene.now_secs += 10 * HUNG
    scene.stalled_secs[OWNER] = 10 * HUNG  # everything was stopped, its main thread too
    scene.beat(OWNER)
    assert scene.judge() == set()
    scene.stalled_secs.clear()
    assert scene.pass_secs(10, OWNER, ONE) == set()


def test_a_process_is_not_taken_for_an_earlier_one_of_the_same_process_id() -> None:
    scene = Scene(OWNER, ROUTER, ONE)
    scene.pass_secs(10, OWNER, ONE)
    assert scene.pass_secs(HUNG + 1, OWNER) == {"one"}
    scene.restart(ONE)
    assert not scene.signs.was_heard(scene.living[ONE])
    assert scene.pass_secs(START_SECS, OWNER) == set()
    assert scene.pass_secs(1, OWNER) == {"one"}


def test_a_standstill_of_the_main_thread_is_blamed_although_heartbeats_come() -> None:
    scene = Scene(OWNER, ROUTER, ONE)
    scene.pass_secs(HUNG, OWNER, ONE)
    scene.stalled_secs[ONE] = HUNG - 1
    assert scene.pass_secs(1, OWNER, ONE) == set()
    scene.stalled_secs[ONE] = HUNG + 1
    assert scene.pass_secs(3, OWNER, ONE) == {"one"}
