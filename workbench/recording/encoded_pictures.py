"""Pictures of one camera and one modality as they lie in a file: encoded, and decoded one at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from numpy.typing import NDArray

Modality = Literal["rgb", "depth", "segmentation"]


@dataclass(frozen=True)
class EncodedPictures:
    modality: Modality
    blobs: Sequence[bytes]

    def __len__(self) -> int:
        return len(self.blobs)

    def blob(self, index: int) -> bytes:
        """Picture `index` as it is kept: JPEG (rgb), 16-bit PNG in millimetres (depth), 16-bit PNG of ids."""
        return self.blobs[index]

    def __getitem__(self, index: int) -> NDArray:
        """Picture `index`: rgb (H, W, 3) uint8; depth (H, W) float32 metres; segmentation (H, W) int32."""
        raise NotImplementedError
