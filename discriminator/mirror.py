"""What a run's journal holds for its discriminators: demonstrations, and D_G as it is announced.

Entries are taken in the journal's order. Each announcement names trajectories that came before it,
so that D_G is the same wherever it is built, and however often.
"""

from __future__ import annotations

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.messages import (
    AttemptEnded,
    IterationAnnounced,
    JournalEntry,
    Rewards,
    TargetsMarked,
    Trajectory,
    TrajectoryId,
    Verdict,
)


class JournalMirror:
    """Follows a journal, and keeps what a discriminator may still be asked about.

    Attributes:
        demonstrations: In the run's record, in their order.
        marks: Targets that a person has marked in them.
        announced: The newest iteration that rewards are wanted for.
        given: The newest rewards in the journal.
        next_offset: Of the entry to be taken next.
    """

    def __init__(self) -> None:
        self.demonstrations: list[Trajectory] = []
        self.marks: list[TargetsMarked] = []
        self.announced: IterationAnnounced | None = None
        self.given: Rewards | None = None
        self.next_offset = 0
        self._trajectories: dict[TrajectoryId, Trajectory] = {}

    def take(self, entry: JournalEntry) -> None:
        """Takes the next entry.

        Raises:
            StorageError: It is not the next one.
            DecodeError: It holds something else than its name says.
        """
        if entry.offset != self.next_offset:
            raise StorageError(
                f"journal: expected entry {self.next_offset}; got {entry.offset}; entries are "
                "followed one by one"
            )
        self.next_offset += 1
        match entry.name.partition("/")[0]:
            case "demonstration":
                self.demonstrations.append(decode(entry.payload, Trajectory))
            case "target":
                self.marks.append(decode(entry.payload, TargetsMarked))
            case "trajectory":
                trajectory = decode(entry.payload, Trajectory)
                self._trajectories[trajectory.id] = trajectory
            case "ended":
                self._forget_unless_accepted(decode(entry.payload, AttemptEnded))
            case "announced":
                self.announced = decode(entry.payload, IterationAnnounced)
                self._forget_what_left(self.announced)
            case "rewards":
                self.given = decode(entry.payload, Rewards)

    @property
    def owed(self) -> IterationAnnounced | None:
        """What waits for rewards, as far as the entries that were taken tell."""
        answered = -1 if self.given is None else self.given.iteration
        if self.announced is None or self.announced.iteration <= answered:
            return None
        return self.announced

    def generated(self, announced: IterationAnnounced) -> list[Trajectory]:
        """The trajectories that the samples of D_G are of, oldest first.

        Args:
            announced: The newest announcement.

        Raises:
            StorageError: The journal does not hold one of them.
        """
        missing = [id_ for id_ in announced.trajectories if id_ not in self._trajectories]
        if missing:
            raise StorageError(
                f"iteration {announced.iteration}: expected trajectory {missing[0]} in the journal "
                "before its announcement; got none; the journal is damaged"
            )
        return [self._trajectories[id_] for id_ in announced.trajectories]

    def _forget_unless_accepted(self, ended: AttemptEnded) -> None:
        if ended.trajectory is not None and ended.verdict is not Verdict.ACCEPTED:
            self._trajectories.pop(ended.trajectory, None)

    def _forget_what_left(self, announced: IterationAnnounced) -> None:
        """Of what is older than D_G's newest, only D_G itself is asked about again."""
        in_memory = set(announced.trajectories)
        newest = self._trajectories.get(announced.trajectories[-1])
        if newest is None:
            return  # `generated` says so, if it is asked
        self._trajectories = {
            id_: it
            for id_, it in self._trajectories.items()
            if id_ in in_memory or it.ticket.index > newest.ticket.index
        }
