"""The README of a run's folder: a model card as hubs of models read it, YAML first and then words."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from handsim.files.outputs import atomic_write
from train.evaluation import percent

MODEL_CARD: Final = "README.md"
UNKNOWN_LICENSE: Final = "unknown"
"""The license of weights as long as who trained them names none; hubs know the word."""
_TAGS: Final = ("handsim", "motion-capture", "hand-tracking", "point-cloud", "marker-labeling")
_KINDS: Final = {"set": "A set labeler", "cnn": "The network of Han et al. 2018"}
_NAMES: Final = {
    "slot_accuracy": "labels and gaps that are right",
    "point_accuracy": "points labeled right",
    "frame_accuracy": "frames without a mistake",
}


def write_model_card(out: Path, card: dict[str, Any]) -> Path:
    """Write the README of a run's folder, complete or not at all, from its card; the page's path.

    A README there is replaced, unless somebody has named a license in it: then it is theirs.
    """
    path = out / MODEL_CARD
    if path.is_file() and _license_line(UNKNOWN_LICENSE) not in path.read_text("utf-8", "replace"):
        return path
    with atomic_write(path) as temporary:
        temporary.write_text(model_card(card), encoding="utf-8")
    return path


def model_card(card: dict[str, Any]) -> str:
    """The README's text: the head that hubs read, and for people data, figures, use and limits."""
    layout = card["dataset"]["layout"]["name"]
    names = card["marker_names"]
    return "\n".join(
        [
            *_head(card["license"]),
            "",
            f"# Labeler of hand markers: {layout}",
            "",
            f"{_KINDS[card['train']['labeler']]} of handsim {card['handsim']}. It gets the points of one",
            f"hand in one frame, in meters, and says for each which of {len(names)} markers it is, or that",
            "it is a ghost.",
            "",
            f"Markers: {', '.join(names)}.",
            "",
            *_data(card),
            "",
            *_figures(card),
            "",
            *_use(layout),
        ]
    )


def _head(license: str) -> list[str]:
    tags = [f"- {tag}" for tag in _TAGS]
    return [
        "---",
        _license_line(license),
        "library_name: handsim",
        "pipeline_tag: other",
        "tags:",
        *tags,
        "---",
    ]


def _license_line(license: str) -> str:
    return f"license: {license}"


def _data(card: dict[str, Any]) -> list[str]:
    dataset, train = card["dataset"], card["train"]
    return [
        "## Data",
        "",
        f"Trained on {card['trained_on']}: {dataset['num_frames']:,} of them, from `handsim generate` with",
        f"seed {dataset['seed']}, of which training saw {train['samples']:,} clouds. `labeler.json` holds",
        "every setting.",
    ]


def _figures(card: dict[str, Any]) -> list[str]:
    columns = card["held_out_simulated"]
    rows = [
        f"| {words} | {' | '.join(percent(column[name]) for column in columns.values())} |"
        for name, words in _NAMES.items()
    ]
    return [
        "## Figures",
        "",
        "On held-out simulated frames, in percent:",
        "",
        f"| | {' | '.join(columns)} |",
        f"|---|{'---|' * len(columns)}",
        *rows,
    ]


def _use(layout: str) -> list[str]:
    return [
        "## Use",
        "",
        "```",
        f"handsim label take.c3d --glove {layout} --labeler THIS_FOLDER --out labeled.c3d",
        "handsim export THIS_FOLDER --out labeler.onnx",
        "```",
        "",
        "In Python, `train.load_labeler(folder).label_frames([points])`. The folder needs",
        "`labeler.safetensors` and `labeler.json`; both are read without unpickling.",
        "",
        "## Limits",
        "",
        "- One hand in one frame; it does not tell left from right.",
        "- Markers of this layout only; moved by more than a centimeter they want a labeler of their own.",
        "- Computed in float32. In bfloat16, which some runtimes choose by themselves, labels change.",
        "",
    ]
