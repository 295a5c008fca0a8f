"""The bus as the other packages see it: typed messages, keys of one run, and no Zenoh.

Each call takes its quality of service from the contract and refuses messages that the contract
does not have for the key. Everything that arrives is taken on threads of its own; what does not
decode is counted in `Bus.rejected` and dropped.
"""

from __future__ import annotations

import atexit
import logging
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Protocol, TypeVar

import zenoh
import zenoh.ext

from broker_config.closing import Closing
from broker_config.codec import decode, encode
from broker_config.contract import Delivery, Row, check_sender, row_of
from broker_config.errors import BusError, MessageError
from broker_config.keys import ParsedKey, RunKeys, parse_key
from broker_config.latest import LatestReader
from broker_config.liveliness import alive_on
from broker_config.messages import Role
from broker_config.pump import Channel, Declared, Pump
from broker_config.quality import reliability, send_options
from broker_config.queries import Handler, PendingReply, Responder, serve_one
from broker_config.rejected import Rejected
from broker_config.session import open_session

_log = logging.getLogger(__name__)

M = TypeVar("M")
Reply = TypeVar("Reply")

_WAITING_QUESTIONS = 16
"""Questions that wait for one server; more wait in the network, not in memory."""
_WAITING_MESSAGES = 64
"""Best-effort messages that wait for one reader; the oldest then make way."""
_WAITING_TOKENS = 256
_MISS_HEARTBEAT_SECS = 0.5
"""A reader that has missed the newest snapshot learns of it after this time."""


class _Puts(Protocol):
    """What Zenoh's plain and advanced publishers share."""

    def put(self, payload: bytes) -> None: ...
    def undeclare(self) -> None: ...


class Publisher:
    """Publishes under one key; made by `Bus.publisher` and `Bus.latest_publisher`."""

    def __init__(self, key: str, row: Row, publisher: _Puts) -> None:
        self._key = key
        self._row = row
        self._publisher = publisher

    def put(self, message: object) -> None:
        """Sends a message; it waits for nobody, and is lost while there is no router.

        Raises:
            MessageError: The contract has another message for the key, or it is too large.
            BusError: The bus is closed.
        """
        if not isinstance(message, self._row.messages):
            raise MessageError(
                f"{self._key}: expected a message of the contract; got {type(message).__name__}"
            )
        payload = encode(message)
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            raise _closed(self._key) from error

    def undeclare(self) -> None:
        """Ends it."""
        self._publisher.undeclare()


class Bus(Closing):
    """What one process says and hears in one run.

    Threads may share it. Handlers run on a thread for each subscription or server; they must be
    quick, and must not ask on the same bus: while they run, their channel may fill, and a full one
    holds up what else the session receives.

    Attributes:
        keys: Builds this run's keys.
        rejected: Counts what did not decode.
    """

    def __init__(
        self,
        session: zenoh.Session,
        run: str,
        role: Role,
        process_id: str,
        rejected: Rejected | None = None,
    ) -> None:
        """Uses an open session, which stays the caller's.

        Args:
            session: Attached to a router.
            run: Which run.
            role: As what.
            process_id: Under which name.
            rejected: Counts together with another bus of the process; None counts apart.

        Raises:
            MessageError: Run or id cannot be part of a key.
        """
        self.keys = RunKeys(run)
        self.rejected = rejected or Rejected()
        self._live_key = self.keys.live(role, process_id)
        self._session = session
        self._declared: list[Callable[[], None]] = []
        self._responders: weakref.WeakSet[Responder] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._is_closed = False
        # A process that ends without closing would otherwise abort: its threads are still inside
        # Zenoh when the interpreter takes itself apart.
        atexit.register(self.close)

    # Questions --------------------------------------------------------------------------------

    def ask(self, key: str, request: object, *expected: type[Reply], timeout_secs: float) -> Reply:
        """Asks and waits for the answer.

        Without a router, or with nobody who serves the key, the failure comes at once: pause
        before you ask again.

        Args:
            key: From `keys`; no pattern.
            request: The contract's message for the key.
            expected: What may be answered.
            timeout_secs: How long to wait.

        Raises:
            Refused: The answer is no.
            OwnerUnreachable: There is no answer; as `OwnerFailed`, the owner has failed on it.
            MessageError: Request or answer break the contract.
            BusError: The bus is closed.
        """
        row = row_of(parse_key(key).kind)
        if not isinstance(request, row.messages):
            raise MessageError(
                f"{key}: expected a message of the contract; got {type(request).__name__}"
            )
        return self.ask_later(key, encode(request), *expected, timeout_secs=timeout_secs).result()

    def ask_later(
        self, key: str, payload: bytes, *expected: type[Reply], timeout_secs: float
    ) -> PendingReply[Reply]:
        """Sends a question and returns; several may be under way.

        Args:
            key: From `keys`; no pattern.
            payload: The encoded request.
            expected: What may be answered.
            timeout_secs: How long to wait, from now.

        Raises:
            MessageError: No key of the contract.
            BusError: The bus is closed.
        """
        quality = row_of(parse_key(key).kind).quality
        self._require_open()
        try:
            replies = self._session.get(
                key,
                zenoh.handlers.FifoChannel(2),
                payload=payload,
                timeout=timeout_secs,
                # The first answer is handed on at once instead of after the last.
                consolidation=zenoh.ConsolidationMode.NONE,
                **send_options(quality),
            )
        except zenoh.ZError as error:
            raise _closed(key) from error
        return PendingReply(key, replies, expected, self.has_router)

    def serve(self, pattern: str, request_type: type[M], handler: Handler[M]) -> None:
        """Answers questions until the bus is closed.

        Args:
            pattern: A key, or `keys.every(...)`.
            request_type: What is asked. Other payloads, and messages that name another sender than
                their key, are counted and refused.
            handler: Gets key, question and the duty to answer. A `MessageError` that it raises is a
                refusal; another exception is logged and told to the asker as the owner's failure.
        """
        queryable = self._session.declare_queryable(
            pattern, zenoh.handlers.FifoChannel(_WAITING_QUESTIONS)
        )

        def take(query: zenoh.Query) -> None:
            serve_one(query, request_type, handler, self.rejected, self._responders.add)

        self._pump(f"serve {pattern}", queryable, queryable.handler, take)

    # Messages ---------------------------------------------------------------------------------

    def publisher(self, key: str) -> Publisher:
        """Publishes best effort: whoever is slow loses messages, nobody waits."""
        row = _row_for(key, Delivery.BEST_EFFORT, Delivery.LIVELINESS)
        publisher = self._session.declare_publisher(
            key,
            reliability=reliability(row.quality),
            **send_options(row.quality),
        )
        return self._own_publisher(key, row, publisher)

    def latest_publisher(self, key: str) -> Publisher:
        """Publishes so that every reader has the newest message in the end, late ones too."""
        row = _row_for(key, Delivery.LATEST)
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            cache=zenoh.ext.CacheConfig(1),
            publisher_detection=True,
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=_MISS_HEARTBEAT_SECS, sporadic_heartbeat=None
            ),
            reliability=reliability(row.quality),
            **send_options(row.quality),
        )
        return self._own_publisher(key, row, publisher)

    def subscribe(
        self,
        pattern: str,
        message_type: type[M],
        handler: Callable[[ParsedKey, M], None],
        most_waiting: int = _WAITING_MESSAGES,
    ) -> None:
        """Hands best-effort messages to `handler` until the bus is closed.

        Args:
            pattern: A key, or `keys.every(...)`.
            message_type: What is published there.
            handler: Gets key and message.
            most_waiting: When more than this wait for the handler, the oldest are dropped.
        """
        subscriber = self._session.declare_subscriber(
            pattern, zenoh.handlers.RingChannel(most_waiting)
        )
        self._pump_samples(pattern, subscriber, subscriber.handler, message_type, handler)

    def latest_reader(self, key: str, message_type: type[M]) -> LatestReader[M]:
        """Keeps the newest message of a key, also one from before this call."""
        _row_for(key, Delivery.LATEST)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session,
            key,
            zenoh.handlers.RingChannel(1),
            history=zenoh.ext.HistoryConfig(max_samples=1, detect_late_publishers=True),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        reader: LatestReader[M] = LatestReader()

        def keep(_: ParsedKey, message: M) -> None:
            reader.set(message)

        self._pump_samples(key, subscriber, subscriber.handler, message_type, keep)
        self._own(reader.close)
        return reader

    # Liveliness -------------------------------------------------------------------------------

    def declare_alive(self) -> None:
        """Shows that this process is attached, until the bus is closed or the process dies."""
        token = self._session.liveliness().declare_token(self._live_key)
        self._own(token.undeclare)

    def alive(self) -> list[ParsedKey]:
        """Which processes are attached to the run now.

        Raises:
            RouterUnreachable: There is no connection to a router.
        """
        return alive_on(self._session, f"{self.keys.run}/live/*/*")

    def watch_alive(self, handler: Callable[[ParsedKey, bool], None]) -> None:
        """Tells of every process that is attached, comes or goes, until the bus is closed."""
        pattern = f"{self.keys.run}/live/*/*"
        subscriber = self._session.liveliness().declare_subscriber(
            pattern, zenoh.handlers.FifoChannel(_WAITING_TOKENS), history=True
        )

        def take(sample: zenoh.Sample) -> None:
            try:
                key = parse_key(str(sample.key_expr))
            except MessageError as error:
                self.rejected.count(str(sample.key_expr), error)
            else:
                handler(key, sample.kind == zenoh.SampleKind.PUT)

        self._pump(f"watch {pattern}", subscriber, subscriber.handler, take)

    def has_router(self) -> bool:
        """Whether there is a connection to a router now."""
        return not self._session.is_closed() and bool(self._session.info.routers_zid())

    # The end ----------------------------------------------------------------------------------

    def close(self) -> None:
        """Ends everything that was declared; questions without an answer are given up."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
        atexit.unregister(self.close)
        for undeclare in reversed(self._declared):
            undeclare()
        for responder in list(self._responders):
            responder.drop()

    def _require_open(self) -> None:
        if self._is_closed:
            raise _closed(self._live_key)

    def _own(self, undeclare: Callable[[], None]) -> None:
        with self._lock:
            if not self._is_closed:
                self._declared.append(undeclare)
                return
        undeclare()
        raise _closed(self._live_key)

    def _pump(
        self, name: str, declared: Declared, channel: Channel[M], take: Callable[[M], None]
    ) -> None:
        self._own(Pump(name, declared, channel, take).close)

    def _pump_samples(
        self,
        pattern: str,
        declared: Declared,
        channel: Channel[zenoh.Sample],
        message_type: type[M],
        handler: Callable[[ParsedKey, M], None],
    ) -> None:
        def take(sample: zenoh.Sample) -> None:
            name = str(sample.key_expr)
            try:
                key = parse_key(name)
                message = decode(sample.payload.to_bytes(), message_type)
                check_sender(key, message)
            except MessageError as error:
                self.rejected.count(name, error)
            else:
                handler(key, message)

        self._pump(f"subscribe {pattern}", declared, channel, take)

    def _own_publisher(self, key: str, row: Row, publisher: _Puts) -> Publisher:
        own = Publisher(key, row, publisher)
        self._own(own.undeclare)
        return own


@contextmanager
def open_bus(
    address: str | None,
    run: str,
    role: Role,
    process_id: str,
    overrides: Sequence[str] = (),
    rejected: Rejected | None = None,
) -> Iterator[Bus]:
    """Attaches to a router and closes everything at the end.

    Args:
        address: The router's, like `tcp/127.0.0.1:7447`; the configuration's if None.
        run: Which run.
        role: As what.
        process_id: Under which name.
        overrides: Zenoh settings, each `key/path=value`.
        rejected: Counts together with another bus of the process; None counts apart.

    Raises:
        RouterUnreachable: Nobody answers at the address.
        ConfigurationError: An override cannot be used.
        MessageError: Run or id cannot be part of a key.
    """
    session = open_session("client", address, overrides)
    try:
        with Bus(session, run, role, process_id, rejected) as bus:
            yield bus
    finally:
        _close(session)


@contextmanager
def open_places(
    address: str | None, run: str, overrides: Sequence[str] = ()
) -> Iterator[Callable[[Role, str], Bus]]:
    """Attaches to a router once, for one process that speaks as several.

    Yields:
        Gives a place on the bus, as a role and under a name; what is still open is closed at the
        end.

    Raises:
        RouterUnreachable: Nobody answers at the address.
        ConfigurationError: An override cannot be used.
    """
    session = open_session("client", address, overrides)
    try:
        with ExitStack() as stack:
            yield lambda role, name: stack.enter_context(Bus(session, run, role, name))
    finally:
        _close(session)


def _row_for(key: str, *deliveries: Delivery) -> Row:
    row = row_of(parse_key(key).kind)
    if row.delivery not in deliveries:
        wanted = " or ".join(deliveries)
        raise MessageError(f"{key}: expected a key for {wanted}; got one for {row.delivery}")
    return row


def _close(session: zenoh.Session) -> None:
    try:
        session.close()  # type: ignore[no-untyped-call]  # stubs leave its return type out
    except zenoh.ZError as error:
        # Somebody has asked for a large answer and does not read it. What counts is acked by now.
        _log.warning("A connection did not close in order: %s", error)


def _closed(subject: str) -> BusError:
    return BusError(f"{subject}: expected an open bus; got a closed one; open it again")
