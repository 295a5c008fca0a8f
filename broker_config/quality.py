"""The contract's quality of service in Zenoh's terms."""

from __future__ import annotations

from typing import TypedDict

import zenoh

from broker_config.contract import Quality

_CONGESTION = {
    "block": zenoh.CongestionControl.BLOCK,
    "drop": zenoh.CongestionControl.DROP,
}
_PRIORITY = {
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "interactive_low": zenoh.Priority.INTERACTIVE_LOW,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "data_low": zenoh.Priority.DATA_LOW,
}


class SendOptions(TypedDict):
    """What Zenoh takes with every publisher and every question."""

    congestion_control: zenoh.CongestionControl
    priority: zenoh.Priority
    express: bool


def send_options(quality: Quality) -> SendOptions:
    """Keyword arguments for whatever sends."""
    return {
        "congestion_control": _CONGESTION[quality.congestion],
        "priority": _PRIORITY[quality.priority],
        "express": quality.is_express,
    }


def reliability(quality: Quality) -> zenoh.Reliability:
    """What publishers take besides."""
    return zenoh.Reliability.RELIABLE if quality.is_reliable else zenoh.Reliability.BEST_EFFORT
