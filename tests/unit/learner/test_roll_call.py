"""Names that living processes have are taken; silence gives them back."""

from __future__ import annotations

from broker_config.codec import SCHEMA_VERSION
from broker_config.messages import Attach, Heartbeat, Role
from broker_config.version import VERSION
from learner.roll_call import SILENCE_SECS, RollCall


def beat(role: Role, id_: str, incarnation: str) -> Heartbeat:
    return Heartbeat(role, id_, incarnation, "host", 1, "fine", 0.0, {})


def wants(role: Role, id_: str, incarnation: str) -> Attach:
    return Attach(role, id_, incarnation, SCHEMA_VERSION, VERSION, "")


def test_an_actor_s_name_is_taken_while_it_lives() -> None:
    roll_call = RollCall()
    roll_call.heard(beat("actor", "a", "first"), 10.0)
    assert roll_call.refusal(wants("actor", "a", "first"), 10.0) is None
    assert roll_call.refusal(wants("actor", "b", "second"), 10.0) is None
    refusal = roll_call.refusal(wants("actor", "a", "second"), 10.0)
    assert refusal is not None
    assert refusal.got == "a, which acts as incarnation first"
    assert roll_call.refusal(wants("actor", "a", "second"), 10.0 + SILENCE_SECS) is None
    assert roll_call.names("actor") == ["a"]


def test_a_run_has_one_discriminator_service_under_whatever_name() -> None:
    roll_call = RollCall()
    assert not roll_call.has_living("discriminator", 10.0)
    roll_call.heard(beat("discriminator", "d", "first"), 10.0)
    assert roll_call.has_living("discriminator", 10.0)
    assert roll_call.refusal(wants("actor", "d", "second"), 10.0) is None
    for name in ("d", "e"):
        refusal = roll_call.refusal(wants("discriminator", name, "second"), 10.0)
        assert refusal is not None
        assert refusal.expected == "no other discriminator service in the run"
    assert roll_call.refusal(wants("discriminator", "e", "second"), 12.0) is None
    assert not roll_call.has_living("discriminator", 12.0)
    assert roll_call.names("actor") == []
