"""Draws the tables of docs/delivery.md, cloth.md, learner.md and recordings.md from results.

python -m tests.benchmarks.tables build/bench/results.jsonl
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.measuring import RESULTS

Line = dict[str, Any]


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def made_by(lines: Sequence[Line], form: str) -> str:
    """What a reader must know of the run."""
    newest = lines[-1]
    return (
        f"\n\n{form}, {newest['at'][:10]}, {newest['machine']}; "
        f"load average of 15 minutes: {newest['load_15_min']:.1f}."
    )


def losses(lines: Sequence[Line]) -> str:
    """Sent, lost and double, by accident and system."""
    counts = lines[-1]["counts"]
    rows = [
        [it["accident"], it["system"], it["sent"], it["arrived"], it["lost"], it["double"]]
        for it in counts
    ]
    head = ["accident", "over", "handed over", "arrived", "lost", "double"]
    form = f"{counts[0]['sent']} messages, {lines[-1]['rate']:.0f} a second"
    return table(head, rows) + made_by(lines, form)


def delivery_load(lines: Sequence[Line]) -> str:
    """Rates and times of each round of the newest command."""
    first = max(number for number, line in enumerate(lines) if line["round"] == 0)
    rounds = lines[first:]
    rows = [
        ["episodes a second, clothbus: acked", *_each(rounds, "clothbus", "acked_per_sec")],
        ["calls a second, Ray: carried", *_each(rounds, "ray", "per_sec")],
        ["calls a second, gRPC: carried", *_each(rounds, "grpc", "per_sec")],
        ["clothbus: ms from last step to ack, p50", *_each(rounds, "clothbus", "ms_to_ack_p50")],
        ["clothbus: ms from last step to ack, p99", *_each(rounds, "clothbus", "ms_to_ack_p99")],
        ["Ray: ms to the reply, p50", *_each(rounds, "ray", "ms_to_reply_p50")],
        ["Ray: ms to the reply, p99", *_each(rounds, "ray", "ms_to_reply_p99")],
        ["gRPC: ms to the reply, p50", *_each(rounds, "grpc", "ms_to_reply_p50")],
        ["gRPC: ms to the reply, p99", *_each(rounds, "grpc", "ms_to_reply_p99")],
        *_policy_rows(rounds),
        ["bytes of a transition", *_each(rounds, "clothbus", "payload_bytes_per_transition")],
        ["the same on the wire", *_each(rounds, "clothbus", "wire_bytes_per_transition")],
    ]  # fmt: skip
    head = ["", *(f"round {number + 1}" for number in range(len(rounds)))]
    return table(head, rows) + made_by(rounds, f"{rounds[0]['clothbus']['episodes']} episodes")


def _policy_rows(rounds: Sequence[Line]) -> list[list[object]]:
    names = {
        "ms from a policy's publication to its first use": "ms_to_first_action_on_a_policy",
        "ms, age of the policy at an episode's start": "policy_age_ms",
        "versions behind the newest": "policy_versions_behind",
    }  # fmt: skip
    return [
        [f"{text}, {share}", *_each(rounds, "clothbus", f"{name}_{share}")]
        for text, name in names.items()
        for share in ("p50", "p99")
    ]


def _each(rounds: Sequence[Line], system: str, name: str) -> list[object]:
    return [line[system].get(name, "not installed") for line in rounds]


def light_actors(lines: Sequence[Line]) -> str:
    """Ingest and memory."""
    it = lines[-1]
    rows: list[list[object]] = [
        ["trajectories a second", it["trajectories_per_sec"]],
        ["MB a second", it["mb_per_sec"]],
        ["trajectories in all", it["trajectories"]],
        ["of these spare (an actor seemed silent for 5 s)", it["spare"]],
        ["processor share of the learner, in cores", it["cpu_share"]["learner"]],
        ["processor share of the router, in cores", it["cpu_share"]["router"]],
    ]
    for name, mib in it["memory"].items():
        rows.append([f"{name}: MiB after the first fifth", mib["begin"]])
        rows.append([f"{name}: MiB at the end", mib["end"]])
        rows.append([f"{name}: MiB at most", mib["most"]])
    form = f"{it['actors']} actors, {it['secs']:.0f} s"
    return table(["", "figure"], rows) + made_by(lines, form)


def recording_load(lines: Sequence[Line]) -> str:
    """The recorder's lag, and what it holds."""
    it = lines[-1]
    rows = [
        ["messages a second", it["messages_per_sec"]],
        ["journal entries recorded", it["journal_entries_recorded"]],
        ["journal entries lost or double", it["journal_entries_lost"]],
        ["lag p50, ms", it["lag_ms_p50"]],
        ["lag p99, ms", it["lag_ms_p99"]],
        ["from the kill until the lag is below 1 s again, s", it["secs_to_catch_up_after_kill"]],
        ["policies trained meanwhile, all recorded", it["policies"]],
        ["views sent, best effort", it["views_sent"]],
        ["views recorded", it["views_recorded"]],
    ]
    return table(["", "figure"], rows) + made_by(lines, f"{it['secs']:.0f} s")


def ingest_costs(lines: Sequence[Line]) -> str:
    """Processor time of each step of ingest."""
    it = lines[-1]
    rows = [[name, f"{secs * 1e3:.2f}"] for name, secs in it["cpu_secs_each"].items()]
    return table(["step", "ms"], rows) + made_by(lines, f"{it['trajectories']} trajectories")


def cloth_speed(lines: Sequence[Line]) -> str:
    """Actions a second of each engine and garment, and their ratios."""
    it = lines[-1]
    medians = {name: sorted(rates)[len(rates) // 2] for name, rates in it["rates"].items()}
    slowest = medians["handkerchief, pybullet as deformable-ravens has it"]
    rows = [
        [
            name, it["vertices"][name], f"{median:.1f}",
            f"{min(it['rates'][name]):.1f} to {max(it['rates'][name]):.1f}",
            f"{median / slowest:.1f}", it["guarded"][name],
        ]
        for name, median in medians.items()
    ]  # fmt: skip
    head = [
        "garment, engine", "vertices", "actions a second and core, median", "least to most",
        "over deformable-ravens' cloth", "guarded",
    ]  # fmt: skip
    n_rounds = len(next(iter(it["rates"].values())))
    return table(head, rows) + made_by(lines, f"{n_rounds} rounds of {it['actions']} actions")


def cloth_blow_ups(lines: Sequence[Line]) -> str:
    """Random actions and guarded steps of the newest line of each task and engine."""
    newest = {(it["task"], it["engine"]): it for it in lines}
    rows = [
        [
            task, engine, it["actions"], sum(it["guarded"].values()),
            f"{100 * sum(it['guarded'].values()) / it['actions']:.3f} %",
            ", ".join(f"{reason} {n}" for reason, n in it["guarded"].items()) or "none",
        ]
        for (task, engine), it in newest.items()
    ]  # fmt: skip
    head = ["task", "engine", "random actions", "guarded", "portion", "reasons"]
    return table(head, rows) + made_by(lines, "Random play from the task's own start")


def engine_comparison(lines: Sequence[Line]) -> str:
    """How unlike the cloth lies after the same actions."""
    it = lines[-1]
    rows = [
        [kind, other, number + 1, found["coverage"], found["iou"], found["distance_mm"]]
        for kind, others in it["medians"].items()
        for other, by_action in others.items()
        for number, found in enumerate(by_action)
    ]
    head = ["garment", "XPBD against", "actions", "coverage, difference", "IoU", "distance, mm"]
    return table(head, rows) + made_by(lines, f"Medians of {it['episodes']} episodes")


def gradient_steps(lines: Sequence[Line]) -> str:
    """Steps a second by minibatch and candidate, of the newest line of each processor."""
    newest = {it["processor"]: it for it in lines}
    return "\n\n".join(_gradient_steps_on(it) for it in newest.values())


def _gradient_steps_on(it: Line) -> str:
    peaks, rows = it["peak_gflop_per_sec"], []
    for batch, candidates in it["found"].items():
        rates = {
            name: sorted(found["steps_per_sec"] for found in results)
            for name, results in candidates.items()
            if results[0]
        }
        slowest = _median(rates["Algorithm 1 as written"])
        for name, each in rates.items():
            peak = peaks["bfloat16" if name.endswith("bf16") else "float32"]
            gflop = _median(each) * int(batch) * it["gflop_per_sample"]
            rows.append(
                [
                    batch, name, f"{_median(each):.1f}", f"{each[0]:.1f} to {each[-1]:.1f}",
                    f"{_median(each) / slowest:.2f}", f"{100 * gflop / peak:.0f} %",
                    f"{max(found['peak_mib'] for found in candidates[name]):.0f}",
                ]
            )  # fmt: skip
    head = [
        "minibatch", "who", "steps a second, median", "least to most", "over as written",
        "of the peak", "peak MiB",
    ]  # fmt: skip
    n_rounds = len(next(iter(it["found"]["32"].values())))
    form = (
        f"{it['processor']}: products of at best {peaks['float32']:.0f} (float32) and "
        f"{peaks['bfloat16']:.0f} (bfloat16) GFLOP/s; {n_rounds} rounds"
    )
    return table(head, rows) + made_by([it], form)


def _median(ordered: Sequence[float]) -> float:
    return ordered[len(ordered) // 2]


def recording_files(lines: Sequence[Line]) -> str:
    """Time, rate and memory of each command on a large recording."""
    it = lines[-1]
    rows = [
        [
            f"`{name.partition(' ')[0]}`{''.join(name.partition(' ')[1:])}",
            found["secs"], found["cpu_secs"],
            f"{1e3 * it['size_gb'] / found['secs']:,.0f}" if name != "info" else "",
            found["peak_mib"], found.get("written_mb", ""),
        ]
        for name, found in it["commands"].items()
    ]  # fmt: skip
    head = ["command", "s", "s of CPU", "MB of the recording a second", "peak MiB", "MB written"]
    form = f"{it['size_gb']} GB in {it['segments']} segments of random pictures"
    return table(head, rows) + made_by(lines, form)


PAGES: dict[Path, dict[str, Callable[[Sequence[Line]], str]]] = {
    Path("docs/delivery.md"): {
        "losses": losses,
        "delivery_load": delivery_load,
        "light_actors": light_actors,
        "recording_load": recording_load,
        "ingest_costs": ingest_costs,
    },
    Path("docs/cloth.md"): {
        "cloth_speed": cloth_speed,
        "cloth_blow_ups": cloth_blow_ups,
        "engine_comparison": engine_comparison,
    },
    Path("docs/learner.md"): {"gradient_steps": gradient_steps},
    Path("docs/recordings.md"): {"recording_files": recording_files},
}


def main() -> None:
    results = Path(sys.argv[1]) if len(sys.argv) > 1 else RESULTS
    lines = [json.loads(text) for text in results.read_text().splitlines()]
    for path, drawn in PAGES.items():
        page = path.read_text()
        for name, draw in drawn.items():
            mine = [line for line in lines if line["benchmark"] == name]
            page = _with_table(page, path, name, draw(mine)) if mine else page
        path.write_text(page)


def _with_table(page: str, path: Path, name: str, text: str) -> str:
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    block = f"{begin}\n{text}\n{end}"
    pattern = f"{re.escape(begin)}.*?{re.escape(end)}"
    page, count = re.subn(pattern, lambda _: block, page, flags=re.S)
    assert count == 1, f"{path} has {count} places for {name}"
    return page


if __name__ == "__main__":
    main()
