"""Pictures of rendered frames, as readers of others find them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image


def depth_of(data: bytes) -> np.ndarray:
    """Depth [m] of a PNG file that states its unit."""
    picture = Image.open(io.BytesIO(data))
    assert picture.format == "PNG" and picture.mode == "I;16"
    return (np.asarray(picture) * float(picture.text["metres_per_unit"])).astype(np.float32)


def exr_content(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and channels of an OpenEXR file."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header()), {name: channel.pixels for name, channel in file.channels().items()}
