"""Zenoh sessions: opened from the annotated files of this folder, with overrides and clear errors.

The values of `router.json5` and `session.json5` are replaced by those of the environment variable
`CLOTHBUS_ZENOH_OVERRIDE` (`key=value;key=value`), and these by the caller's: a given address and
overrides from the command line.
"""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Literal

import zenoh

from broker_config.errors import AddressInUse, BusError, ConfigurationError, RouterUnreachable

Mode = Literal["router", "client"]

DEFAULT_ADDRESS = "tcp/127.0.0.1:7447"
OVERRIDE_VARIABLE = "CLOTHBUS_ZENOH_OVERRIDE"

_FILES: dict[Mode, str] = {"router": "router.json5", "client": "session.json5"}
_ENDPOINTS: dict[Mode, str] = {"router": "listen/endpoints", "client": "connect/endpoints"}
_PORT_TRIES = 20
BUSY_ROUTER_SECS = 20.0
"""A router that listens but does not answer is waited for: while it holds a link on which nothing
moves any more, it takes in nobody."""


def open_session(
    mode: Mode,
    address: str | None = None,
    overrides: Sequence[str] = (),
    *,
    config_file: Path | None = None,
    environment: Mapping[str, str] = os.environ,
) -> zenoh.Session:
    """Opens a session; use it as a context manager, or close it.

    A session in mode "router" is a router: give it a process of its own.

    Args:
        mode: Whether to be a router or to attach to one.
        address: Where to listen or to connect, like `tcp/127.0.0.1:7447`; the configuration's if
            None.
        overrides: Each `key/path=value` with a JSON5 value.
        config_file: A JSON5 file that takes the place of this folder's.
        environment: Where `CLOTHBUS_ZENOH_OVERRIDE` is looked up.

    Raises:
        ConfigurationError: An unknown key, or an unusable value.
        RouterUnreachable: Nobody answers at the address within `connect/timeout_ms`, or within
            `BUSY_ROUTER_SECS` where somebody listens.
        AddressInUse: Another process listens there.
    """
    config = load_config(mode, address, overrides, config_file, environment)
    endpoints = json.loads(config.get_json(_ENDPOINTS[mode]))
    deadline = time.monotonic() + BUSY_ROUTER_SECS
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            explained = _explained(mode, ", ".join(endpoints), error)
            unreachable = isinstance(explained, RouterUnreachable)
            if not (unreachable and time.monotonic() < deadline and _somebody_listens(endpoints)):
                raise explained from error


def open_router_on_free_port(
    host: str = "127.0.0.1",
    overrides: Sequence[str] = (),
    *,
    environment: Mapping[str, str] = os.environ,
) -> tuple[zenoh.Session, str]:
    """Opens a router on a port that was free, and says at which address.

    The process that listens is the one that chooses, and it chooses again when another process was
    faster: there is no moment in which the port is promised but not taken.

    Raises:
        ConfigurationError: An unknown key, or an unusable value.
        AddressInUse: No free port was found.
    """
    last_error: AddressInUse | None = None
    for port in _free_ports(host):
        address = f"tcp/{host}:{port}"
        try:
            return open_session("router", address, overrides, environment=environment), address
        except AddressInUse as error:
            last_error = error
    raise AddressInUse(
        f"router on {host}: expected a free port; got {_PORT_TRIES} that were taken; "
        "give an address with --listen"
    ) from last_error


def _somebody_listens(endpoints: Sequence[str]) -> bool:
    """Whether one of the addresses takes connections; of TCP addresses alone it can be said."""
    for endpoint in endpoints:
        transport, _, place = endpoint.partition("/")
        host, _, port = place.partition("?")[0].rpartition(":")
        if transport != "tcp" or not port.isdigit():
            continue
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=1.0).close()
        except OSError:
            continue
        return True
    return False


def _free_ports(host: str) -> Iterator[int]:
    for _ in range(_PORT_TRIES):
        with socket.create_server((host, 0)) as probe:
            port: int = probe.getsockname()[1]
        yield port


def load_config(
    mode: Mode,
    address: str | None = None,
    overrides: Sequence[str] = (),
    config_file: Path | None = None,
    environment: Mapping[str, str] = os.environ,
) -> zenoh.Config:
    """Puts file, environment and command line together; arguments as for `open_session`.

    Raises:
        ConfigurationError: An unknown key, or an unusable value.
    """
    config = _read_file(mode, config_file)
    variable = environment.get(OVERRIDE_VARIABLE, "")
    for override in filter(None, (part.strip() for part in variable.split(";"))):
        _override(config, override, f"environment variable {OVERRIDE_VARIABLE}")
    if address is not None:
        _insert(config, _ENDPOINTS[mode], json.dumps([address]), "the given address")
    for override in overrides:
        _override(config, override, "the command line")
    # Last: a file or an override that makes a peer of it would go round the router.
    _insert(config, "mode", json.dumps(mode), "clothbus")
    return config


def _read_file(mode: Mode, config_file: Path | None) -> zenoh.Config:
    try:
        if config_file is None:
            text = (resources.files("broker_config") / _FILES[mode]).read_text("utf-8")
        else:
            text = config_file.read_text("utf-8")
        return zenoh.Config.from_json5(text)
    except (OSError, UnicodeDecodeError, zenoh.ZError) as error:
        raise ConfigurationError(
            f"Zenoh configuration {config_file or _FILES[mode]}: expected a readable JSON5 file "
            f"with Zenoh's keys; got {_reason(error)}; correct that file"
        ) from error


def _override(config: zenoh.Config, override: str, origin: str) -> None:
    key, separator, value = override.partition("=")
    if not separator:
        raise ConfigurationError(
            f"Zenoh override {override!r} from {origin}: expected key/path=value; "
            "write for example connect/timeout_ms=10000"
        )
    _insert(config, key.strip(), value.strip(), origin)


def _insert(config: zenoh.Config, key: str, value: str, origin: str) -> None:
    try:
        config.insert_json5(key, value)
    except zenoh.ZError as error:
        raise ConfigurationError(
            f"Zenoh key {key!r} from {origin}: expected a key of Zenoh and a JSON5 value for it "
            f"(text in double quotes); got {value} ({_reason(error)}); see router.json5 and "
            "session.json5 for keys in use"
        ) from error


def _explained(mode: Mode, endpoints: str, error: zenoh.ZError) -> BusError:
    reason = _reason(error)
    if mode == "router" and "in use" in reason:
        return AddressInUse(
            f"router: expected a free address; got {endpoints}, where another process listens; "
            "use that router, or choose another port with --listen"
        )
    if mode == "client" and "Unable to connect" in reason:
        return RouterUnreachable(
            f"router: expected an answer at {endpoints}; got none; start one with `clothbus router "
            f"--listen {endpoints.split(', ')[0]}`, or check the address, the firewall and, with "
            "TLS, both ends' certificates (a refused certificate looks the same)"
        )
    return ConfigurationError(
        f"Zenoh {mode}: expected usable endpoints and settings; got {reason} for {endpoints}; "
        "correct the address or the overrides"
    )


def _reason(error: Exception) -> str:
    """Zenoh's own words, without the places in its source and the wrapping of its JSON5 reader."""
    text = re.sub(r" at \S+\.rs:\d+\.", "", str(error)).strip()
    if (
        quoted := re.search(r'"((?:[^"\\]|\\.)*)"', text)
        if "Err(" in text or "Str(" in text
        else None
    ):
        text = quoted[1].replace('\\"', '"').replace("\\n", " ")
    return text.rpartition(" = ")[2].strip()
