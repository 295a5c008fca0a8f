"""Keys, the contract, and the README that prints it."""

import itertools
from importlib import resources

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from broker_config.codec import SIZE_LIMITS
from broker_config.contract import CONTRACT, Delivery, check_sender, markdown_table, row_of
from broker_config.errors import MessageError
from broker_config.keys import ALL_OWNERS, ROLES, Kind, ParsedKey, RunKeys, parse_key
from broker_config.messages import Attach, Heartbeat, Metrics, TicketRequest
from broker_config.session import load_config

ids = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,63}", fullmatch=True)


@given(ids, ids, st.sampled_from(ROLES), st.integers(0, 2**63 - 1))
def test_every_key_is_parsed_back(run, name, role, version):
    keys = RunKeys(run)
    expected = {
        keys.attach(role, name): ParsedKey(run, Kind.ATTACH, role, name),
        keys.ticket(name): ParsedKey(run, Kind.TICKET, "actor", name),
        keys.trajectory(name): ParsedKey(run, Kind.TRAJECTORY, "actor", name),
        keys.journal("recorder", "r"): ParsedKey(run, Kind.JOURNAL, "recorder", "r"),
        keys.view("a"): ParsedKey(run, Kind.VIEW, "actor", "a"),
        keys.rewards("d"): ParsedKey(run, Kind.REWARDS, "discriminator", "d"),
        keys.discriminators: ParsedKey(run, Kind.DISCRIMINATORS),
        keys.policy: ParsedKey(run, Kind.POLICY),
        keys.policy_version(version): ParsedKey(run, Kind.POLICY_VERSION, version=version),
        keys.metrics(role, name): ParsedKey(run, Kind.METRICS, role, name),
        keys.live(role, name): ParsedKey(run, Kind.LIVE, role, name),
        keys.control: ParsedKey(run, Kind.CONTROL),
    }
    assert {parsed.kind for parsed in expected.values()} == set(Kind)
    for key, parsed in expected.items():
        assert parse_key(key) == parsed
        assert str(parsed) == key
        assert zenoh.KeyExpr(keys.every(parsed.kind)).includes(key)
    assert zenoh.KeyExpr(ALL_OWNERS).includes(keys.live("owner", name))


def test_patterns_of_two_kinds_never_overlap():
    keys = RunKeys("run")
    for left, right in itertools.combinations(Kind, 2):
        assert not zenoh.KeyExpr(keys.every(left)).intersects(keys.every(right))


@given(st.text(alphabet="ab/*$#?-_09A ", max_size=30))
def test_other_text_is_refused_or_is_a_key(text):
    try:
        parsed = parse_key(text)
    except MessageError:
        return
    assert str(parsed) == text


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("run/nothing", "key: expected one of <run>/attach"),
        ("run/ticket", "key: expected one of"),
        ("run/ticket/*", "key's actor"),
        ("RUN/control", "key's run"),
        ("run/live/robot/a", "key's role: expected one of router, owner, actor, discriminator"),
        ("run/policy/01", "key's version"),
        ("run/policy/-1", "key's version"),
        ("run/policy/٣", "key's version"),
        ("run/policy/" + "9" * 5000, "key's version"),
        ("", "key: expected one of"),
    ],
)
def test_keys_that_are_none_are_named(key, text):
    with pytest.raises(MessageError, match=text) as error:
        parse_key(key)
    assert len(str(error.value)) < 400


def test_keys_are_not_built_from_ids_that_no_key_may_have():
    keys = RunKeys("run")
    for build in (lambda: RunKeys("a/b"), lambda: keys.ticket("*"), lambda: keys.live("owner", "")):
        with pytest.raises(MessageError, match="expected 1 to 64"):
            build()
    with pytest.raises(MessageError, match="role"):
        keys.live("robot", "a")
    with pytest.raises(MessageError, match="version"):
        keys.policy_version(-1)


def test_the_contract_has_one_row_for_each_kind_of_key():
    assert [row.kind for row in CONTRACT] == list(Kind)
    assert all(row_of(row.kind) is row for row in CONTRACT)


def test_only_queries_block_and_only_queries_are_answered():
    for row in CONTRACT:
        is_query = row.delivery is Delivery.QUERY
        assert (row.quality.congestion == "block") == is_query, row.kind
        assert bool(row.replies) == is_query, row.kind
        assert set(row.messages) | set(row.replies) <= set(SIZE_LIMITS)


def test_the_readme_prints_the_contract():
    readme = (resources.files("broker_config") / "README.md").read_text("utf-8")
    printed = "\n".join(line for line in readme.splitlines() if line.startswith("| key "))
    assert printed, "the README has a table of keys"
    assert markdown_table() in readme, f"replace the README's table by:\n{markdown_table()}"


def test_the_transport_takes_the_largest_message_of_the_contract():
    for mode in ("router", "client"):
        limit = int(load_config(mode).get_json("transport/link/rx/max_message_size"))
        assert max(SIZE_LIMITS.values()) < limit < 2 * max(SIZE_LIMITS.values())


@pytest.mark.parametrize(
    ("message", "sound", "foreign"),
    [
        (TicketRequest("a", "i", "n"), "r/ticket/a", "r/ticket/b"),
        (Attach("actor", "a", "i", 1, "0", ""), "r/attach/actor/a", "r/attach/owner/a"),
        (Metrics("actor", "a", "i", 0, 0, {}), "r/metrics/actor/a", "r/metrics/actor/b"),
        (
            Heartbeat("actor", "a", "i", "h", 1, "s", 0.0, {}),
            "r/live/actor/a",
            "r/live/observer/a",
        ),
    ],
)
def test_a_message_under_another_senders_key_is_refused(message, sound, foreign):
    check_sender(parse_key(sound), message)
    with pytest.raises(MessageError, match="expected the sender of its key"):
        check_sender(parse_key(foreign), message)
