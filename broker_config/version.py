"""The version of clothbus, which every process tells the owner of a run when it attaches."""

VERSION = "0.1.0"
