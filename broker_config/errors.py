"""Everything that clothbus raises on purpose.

::

    ClothbusError
    |-- PresetError            a preset or an override that cannot be used
    |-- MessageError           a message that breaks the contract
    |   |-- DecodeError        bytes that are no message, or not the expected one
    |   `-- SchemaMismatch     a message of another schema version
    |-- BusError
    |   |-- ConfigurationError an unknown key or unusable value in a Zenoh configuration
    |   |-- RouterUnreachable  no router answers at the address
    |   |-- AddressInUse       another process listens at the router's address
    |   |-- OwnerUnreachable   no answer from the run's owner; asking again is safe
    |   |   `-- OwnerFailed    the owner was asked and failed on it; its log says why
    |   |-- Refused            the owner does not do what it was asked, and says why
    |   `-- AttachRefused      the owner refuses: versions or presets differ
    `-- StorageError           a journal, spool or checkpoint that cannot be read or written
        |-- AlreadyOwned       another process owns the run
        `-- SpoolFull          an actor's spool holds as much as it may

Each message reads *subject: expected rule; got value; what to do*.
"""

from __future__ import annotations


class ClothbusError(Exception):
    """Base of every error that clothbus raises on purpose; its text is meant for a person."""


class PresetError(ClothbusError):
    """A preset or an override that cannot be used."""


class MessageError(ClothbusError, ValueError):
    """A message that breaks the contract."""


class DecodeError(MessageError):
    """Bytes that are no message, or not the expected one."""


class SchemaMismatch(MessageError):
    """A message of another schema version."""


class BusError(ClothbusError):
    """The bus cannot be used as asked."""


class ConfigurationError(BusError):
    """An unknown key or an unusable value in a Zenoh configuration."""


class RouterUnreachable(BusError):
    """No router answers at the address."""


class AddressInUse(BusError):
    """Another process listens at the router's address."""


class OwnerUnreachable(BusError):
    """No answer from the run's owner; asking again is safe."""


class OwnerFailed(OwnerUnreachable):
    """The owner was asked and failed on it; its log says why."""


class Refused(BusError):
    """The owner does not do what it was asked, and says why; asking again will not help."""


class AttachRefused(BusError):
    """The owner of the run refuses the process: versions or presets differ."""


class StorageError(ClothbusError):
    """A journal, spool or checkpoint that cannot be read or written."""


class AlreadyOwned(StorageError):
    """Another process owns the run."""


class SpoolFull(StorageError):
    """An actor's spool holds as much as it may."""
