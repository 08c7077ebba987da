"""The command `handsim export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from handsim.app.messages import print_line
from handsim.errors import HandSimError
from handsim.files.outputs import check_outputs


def export(labeler: Annotated[str, tyro.conf.Positional], out: Path) -> None:
    """Write a trained set labeler as one .onnx file, which labels without torch.

    Args:
        labeler: A glove with a shipped labeler, or the folder of a trained one.
        out: The .onnx file.
    """
    from train.labelers.onnx_labeler import export_onnx
    from train.labelers.storage import load_network

    if out.suffix.lower() != ".onnx":
        raise HandSimError(f"cannot write '{out}', expected a name that ends in .onnx")
    check_outputs([labeler], [out])
    network, card = load_network(labeler)
    export_onnx(network, card["marker_names"], out)
    print_line(f"{out}: {len(card['marker_names'])} markers")
