"""Who was heard of on the bus, and which names are taken: for the owner, who lets others join."""

from __future__ import annotations

from broker_config.messages import Attach, Heartbeat, Refusal, Role

SILENCE_SECS = 1.5
"""Three heartbeats: a process that was not heard of for so long has left its name."""


class RollCall:
    """The newest sign of life of each process."""

    def __init__(self) -> None:
        self._heard: dict[tuple[str, str], tuple[str, float]] = {}
        """Incarnation by role and id, and when it was last heard of."""

    def heard(self, heartbeat: Heartbeat, now_secs: float) -> None:
        """Notes a sign of life."""
        self._heard[heartbeat.role, heartbeat.id] = heartbeat.incarnation, now_secs

    def joined(self, request: Attach, now_secs: float) -> None:
        """Notes a process that was let in: its first heartbeat is on its way."""
        self._heard[request.role, request.id] = request.incarnation, now_secs

    def names(self, role: Role) -> list[str]:
        """Of all processes of a role that were ever heard of."""
        return [id_ for known, id_ in list(self._heard) if known == role]

    def has_living(self, role: Role, now_secs: float) -> bool:
        """Whether a process of a role was heard of just now."""
        return any(
            known == role and now_secs - heard_secs < SILENCE_SECS
            for (known, _), (_, heard_secs) in list(self._heard.items())
        )

    def refusal(self, request: Attach, now_secs: float) -> Refusal | None:
        """Why a process must not join beside those that live; None if it may.

        No two actors have one name. A run has one discriminator service, since each iteration gets
        its rewards once.
        """
        for (role, id_), (incarnation, heard_secs) in list(self._heard.items()):
            is_itself = (id_, incarnation) == (request.id, request.incarnation)
            if role != request.role or is_itself or now_secs - heard_secs >= SILENCE_SECS:
                continue
            if role == "actor" and id_ == request.id:
                return Refusal(
                    "actor name",
                    "a name that no living actor has",
                    f"{id_}, which acts as incarnation {incarnation}",
                    "choose another --id, or end the other process first",
                )
            if role == "discriminator":
                return Refusal(
                    "discriminator",
                    "no other discriminator service in the run",
                    f"{id_}, which runs as incarnation {incarnation}",
                    "end the other process first",
                )
        return None
