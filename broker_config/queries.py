"""Questions and answers: both ends of a Zenoh query.

An answer is a message of the contract or a `Refusal`. A failure of the answering side travels as
Zenoh's error reply, so that the asker can tell "no" from "not now".
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar, cast

import zenoh

from broker_config.codec import decode, encode
from broker_config.contract import Row, check_sender, row_of
from broker_config.errors import MessageError, OwnerFailed, OwnerUnreachable, Refused
from broker_config.keys import ParsedKey, parse_key
from broker_config.messages import Refusal
from broker_config.rejected import Rejected

_log = logging.getLogger(__name__)

Request = TypeVar("Request")
Reply = TypeVar("Reply")

_ZENOH_TIMEOUT = b"Timeout"
"""What Zenoh itself puts into the error reply of a query that nobody has answered in time."""


class PendingReply(Generic[Reply]):
    """An answer that is under way."""

    def __init__(
        self,
        key: str,
        replies: zenoh.Handler[zenoh.Reply],
        expected: tuple[type[Reply], ...],
        has_router: Callable[[], bool],
    ) -> None:
        self._key = key
        self._replies = replies
        self._expected = expected
        self._has_router = has_router

    def result(self) -> Reply:
        """Waits for the answer, at most as long as was said when asking. Call it once.

        Raises:
            Refused: The owner's answer is no.
            OwnerUnreachable: Nobody has answered.
            OwnerFailed: The owner has failed on the question.
            DecodeError: The answer is none of the expected messages.
            SchemaMismatch: The owner has another schema version.
        """
        failure = b""
        for reply in self._replies:
            if (sample := reply.ok) is not None:
                return self._open(sample.payload.to_bytes())
            if (error := reply.err) is not None:
                failure = error.payload.to_bytes()
        if failure and failure != _ZENOH_TIMEOUT:
            raise OwnerFailed(
                f"{self._key}: expected an answer; got {failure.decode(errors='replace')}; "
                "see the owner's log"
            )
        raise OwnerUnreachable(self._silence(timed_out=bool(failure)))

    def _open(self, payload: bytes) -> Reply:
        answer = decode(payload, *self._expected, Refusal)
        if isinstance(answer, Refusal):
            raise Refused(
                f"{answer.subject}: expected {answer.expected}; got {answer.got}; {answer.advice}"
            )
        return cast(Reply, answer)

    def _silence(self, timed_out: bool) -> str:
        if not self._has_router():
            cause = "no connection to a router; start it again, attached processes find it"
        elif timed_out:
            cause = "none in time; the owner is busy, stopped or has just gone"
        else:
            cause = "nobody who serves it; start the run's owner, or check the run's name"
        return f"{self._key}: expected an answer; got {cause}"


class Responder:
    """The duty to answer one question, from any thread, now or later.

    Dropped without an answer, it tells the asker at once that there is none.

    Attributes:
        question: The encoded request, as it was sent.
    """

    def __init__(self, query: zenoh.Query, row: Row) -> None:
        self._key = str(query.key_expr)
        payload = query.payload
        self.question = b"" if payload is None else payload.to_bytes()
        self._query: zenoh.Query | None = query
        self._row = row
        self._lock = threading.Lock()

    @property
    def is_answered(self) -> bool:
        """Whether it was answered or dropped."""
        with self._lock:
            return self._query is None

    def reply(self, message: object) -> None:
        """Answers; an asker that no longer waits is no error.

        Args:
            message: One of the replies of the contract for this key, or a `Refusal`.

        Raises:
            TypeError: The contract has another reply for this key.
            MessageError: The reply is too large.
            RuntimeError: The question was answered before.
        """
        if not isinstance(message, (*self._row.replies, Refusal)):
            raise TypeError(
                f"{self._key}: expected a reply of the contract; got {type(message).__name__}"
            )
        payload = encode(message)
        self._finish(lambda query: query.reply(query.key_expr, payload))

    def refuse(self, error: MessageError) -> None:
        """Answers that the question breaks a rule."""
        self.reply(_refusal(self._key, error))

    def fail(self, error: Exception) -> None:
        """Answers that answering has failed, and that asking again is safe."""
        text = f"{type(error).__name__}: {error}"
        self._finish(lambda query: query.reply_err(text.encode()[:4096]))

    def drop(self) -> None:
        """Gives the duty up; the asker hears that there is no answer. Again: does nothing."""
        with self._lock:
            query, self._query = self._query, None
        if query is not None:
            _drop(query)

    def _finish(self, answer: Callable[[zenoh.Query], None]) -> None:
        with self._lock:
            query, self._query = self._query, None
        if query is None:
            raise RuntimeError(f"{self._key}: answered twice; answer each question once")
        try:
            answer(query)
        except zenoh.ZError as error:
            _log.debug("%s: the answer did not leave: %s", self._key, error)
        finally:
            _drop(query)


Handler = Callable[[ParsedKey, Request, Responder], None]


def serve_one(
    query: zenoh.Query,
    request_type: type[Request],
    handler: Handler[Request],
    rejected: Rejected,
    remember: Callable[[Responder], None],
) -> None:
    """Decodes one question and hands it to `handler`; whatever is wrong goes to the asker."""
    name = str(query.key_expr)
    try:
        key = parse_key(name)
    except MessageError as error:
        rejected.count(name, error)
        query.reply_err(str(error).encode()[:4096])
        _drop(query)
        return
    responder = Responder(query, row_of(key.kind))
    remember(responder)
    try:
        request = decode(responder.question, request_type)
        check_sender(key, request)
        handler(key, request, responder)
    except MessageError as error:
        rejected.count(name, error)
        if not responder.is_answered:
            responder.refuse(error)
    except Exception as error:
        _log.exception("%s: the question was not answered", name)
        if not responder.is_answered:
            responder.fail(error)


def _drop(query: zenoh.Query) -> None:
    query.drop()  # type: ignore[no-untyped-call]  # zenoh's stubs leave its return type out


def _refusal(key: str, error: MessageError) -> Refusal:
    """Splits an error of the house's form into the fields of a refusal."""
    subject, found, rest = str(error).partition(": expected ")
    if not found:
        subject, rest = key, f"a request that keeps the contract; got {error}"
    expected, _, rest = rest.partition("; got ")
    got, _, advice = rest.partition("; ")
    return Refusal(
        subject=subject[:1000],
        expected=expected[:2000],
        got=(got or "something else")[:2000],
        advice=(advice or f"correct what is sent on {key}")[:2000],
    )
