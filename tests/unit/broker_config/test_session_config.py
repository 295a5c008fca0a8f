"""How file, environment and command line make a Zenoh configuration."""

import pytest

from broker_config.errors import ConfigurationError
from broker_config.session import DEFAULT_ADDRESS, OVERRIDE_VARIABLE, load_config

LEASE = "transport/link/tx/lease"


def test_the_files_are_what_zenoh_accepts_and_decide_the_defaults():
    router, client = load_config("router", environment={}), load_config("client", environment={})
    assert router.get_json("mode") == '"router"'
    assert client.get_json("mode") == '"client"'
    assert router.get_json("listen/endpoints") == f'["{DEFAULT_ADDRESS}"]'
    assert client.get_json("connect/endpoints") == f'["{DEFAULT_ADDRESS}"]'
    for config in (router, client):
        assert config.get_json(LEASE) == "10000"
        assert config.get_json("scouting/multicast/enabled") == "false"
        assert config.get_json("timestamping/enabled") == "true"
        assert config.get_json("transport/shared_memory/enabled") == "false"


def test_the_command_line_is_stronger_than_the_environment_and_this_than_the_file():
    environment = {OVERRIDE_VARIABLE: f" {LEASE}=1111 ; connect/timeout_ms=77; "}
    config = load_config("client", None, [], None, environment)
    assert (config.get_json(LEASE), config.get_json("connect/timeout_ms")) == ("1111", "77")
    config = load_config("client", None, [f"{LEASE} = 2222"], None, environment)
    assert (config.get_json(LEASE), config.get_json("connect/timeout_ms")) == ("2222", "77")


def test_a_given_address_is_stronger_than_the_environment():
    environment = {OVERRIDE_VARIABLE: 'connect/endpoints=["tcp/10.0.0.1:1"]'}
    config = load_config("client", None, [], None, environment)
    assert config.get_json("connect/endpoints") == '["tcp/10.0.0.1:1"]'
    config = load_config("client", "tcp/10.0.0.2:2", [], None, environment)
    assert config.get_json("connect/endpoints") == '["tcp/10.0.0.2:2"]'


def test_the_mode_cannot_be_overridden():
    assert load_config("client", None, ['mode="peer"']).get_json("mode") == '"client"'


def test_another_file_takes_the_place_of_ours(tmp_path):
    file = tmp_path / "own.json5"
    file.write_text("{ transport: { link: { tx: { lease: 4321 } } } } // ours")
    assert load_config("router", None, [], file, {}).get_json(LEASE) == "4321"


@pytest.mark.parametrize(
    "text", ["{ nope: 1 }", "{ transport: { nope: 1 } }", "{ mode: ", '{ mode: "x" }', None]
)
def test_a_file_that_cannot_be_used_is_named(tmp_path, text):
    file = tmp_path / "own.json5"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ConfigurationError, match=r"own\.json5: expected a readable JSON5 file"):
        load_config("router", config_file=file)


def test_errors_do_not_show_the_places_in_zenohs_source():
    with pytest.raises(ConfigurationError) as error:
        load_config("client", None, ['scouting/multicast/enabled="maybe"'])
    assert "expected a boolean" in str(error.value)
    assert ".rs" not in str(error.value)
    assert "Json5Err" not in str(error.value)
