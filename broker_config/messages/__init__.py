"""What may be said on the bus: frozen messages that refuse to exist when they are wrong.

The README of the folder above lists the key under which each message travels.
"""

from broker_config.messages.control import (
    Command,
    Control,
    ControlReply,
)
from broker_config.messages.demonstrations import (
    DemonstrationsBegun,
    Demonstrator,
    FoundQuality,
    ImportedDataset,
    SnapshotPlayed,
    TargetsMarked,
)
from broker_config.messages.imitation import (
    DiscriminatorSnapshot,
    IterationAnnounced,
    Rewards,
    RewardsAck,
    generated_digest,
)
from broker_config.messages.journal import (
    AttemptEnded,
    FollowerJoined,
    IterationEnded,
    JournalBatch,
    JournalEntry,
    JournalRequest,
    RunStarted,
    SnapshotTaken,
    TicketIssued,
    TicketReseeded,
)
from broker_config.messages.policies import (
    Snapshot,
    SnapshotRequest,
    weights_digest,
)
from broker_config.messages.presence import (
    Attach,
    Heartbeat,
    Refusal,
    Role,
    Welcome,
)
from broker_config.messages.recordings import (
    Presence,
    RecorderStarted,
    RecordingGap,
)
from broker_config.messages.rules import (
    require_id,
)
from broker_config.messages.telemetry import (
    JointMotion,
    Mark,
    Metrics,
    View,
)
from broker_config.messages.tickets import (
    Instruction,
    Ticket,
    TicketReply,
    TicketRequest,
)
from broker_config.messages.trajectories import (
    Ack,
    Trajectory,
    TrajectoryId,
    Verdict,
)

__all__ = [
    "Ack",
    "Attach",
    "AttemptEnded",
    "Command",
    "Control",
    "ControlReply",
    "DemonstrationsBegun",
    "Demonstrator",
    "DiscriminatorSnapshot",
    "FollowerJoined",
    "FoundQuality",
    "Heartbeat",
    "ImportedDataset",
    "Instruction",
    "IterationAnnounced",
    "IterationEnded",
    "JointMotion",
    "JournalBatch",
    "JournalEntry",
    "JournalRequest",
    "Mark",
    "Metrics",
    "Presence",
    "RecorderStarted",
    "RecordingGap",
    "Refusal",
    "Rewards",
    "RewardsAck",
    "Role",
    "RunStarted",
    "Snapshot",
    "SnapshotPlayed",
    "SnapshotRequest",
    "SnapshotTaken",
    "TargetsMarked",
    "Ticket",
    "TicketIssued",
    "TicketReply",
    "TicketRequest",
    "TicketReseeded",
    "Trajectory",
    "TrajectoryId",
    "Verdict",
    "View",
    "Welcome",
    "generated_digest",
    "require_id",
    "weights_digest",
]
