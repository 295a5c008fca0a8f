"""Who is there: liveliness tokens, which vanish with the process that holds them."""

from __future__ import annotations

import zenoh

from broker_config.errors import MessageError, RouterUnreachable
from broker_config.keys import ALL_OWNERS, ParsedKey, parse_key

_TIMEOUT_SECS = 3.0
_WAITING_TOKENS = 256


def runs_on(session: zenoh.Session) -> list[str]:
    """The runs with a live owner that the session's router carries, sorted.

    Raises:
        RouterUnreachable: There is no connection to a router.
    """
    return sorted({key.run for key in alive_on(session, ALL_OWNERS)})


def alive_on(session: zenoh.Session, pattern: str) -> list[ParsedKey]:
    """The keys of all live tokens that match a pattern, sorted.

    Raises:
        RouterUnreachable: There is no connection to a router.
    """
    if session.is_closed() or not session.info.routers_zid():
        raise RouterUnreachable(
            "liveliness: expected a connection to a router; got none; start the router again, "
            "attached processes find it"
        )
    replies = session.liveliness().get(
        pattern, zenoh.handlers.FifoChannel(_WAITING_TOKENS), timeout=_TIMEOUT_SECS
    )
    found = []
    for reply in replies:
        if (sample := reply.ok) is not None:
            try:
                found.append(parse_key(str(sample.key_expr)))
            except MessageError:
                continue  # another program's token
    return sorted(found, key=str)
