"""What a person has asked of a run: whether it pauses, stops, or lets actors go."""

from __future__ import annotations

from collections.abc import Iterable

from broker_config.messages import Command, Control, Instruction


class Steering:
    """The standing orders; for one thread at a time. Each command changes them once, in order."""

    def __init__(self) -> None:
        self.is_paused = False
        self.is_stopping = False
        self._draining: set[str] = set()

    def apply(self, control: Control) -> None:
        """Obeys a command that is about tickets; a `drain` names its actor."""
        match control.command:
            case Command.PAUSE:
                self.is_paused = True
            case Command.RESUME:
                self.is_paused = False
                self._draining.clear()
            case Command.DRAIN if control.process is not None:
                self._draining.add(control.process)
            case Command.STOP:
                self.is_stopping = True

    def farewell(self, actor: str) -> Instruction | None:
        """What an actor hears in place of a ticket."""
        if self.is_stopping:
            return Instruction.STOP
        return Instruction.DRAIN if actor in self._draining else None

    @property
    def state(self) -> str:
        """A word for a person."""
        return "stopping" if self.is_stopping else "paused" if self.is_paused else "running"


def spelled_out(control: Control, actors: Iterable[str]) -> list[Control]:
    """A command as it is recorded: a `drain` of all names each of those who are there."""
    if control.command is Command.DRAIN and control.process is None:
        return [control, *(Control(Command.DRAIN, actor) for actor in actors)]
    return [control]
