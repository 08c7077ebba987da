"""Videos and photographs of hands: found, registered to tracked takes, and labeled.

`register_camera` finds where the camera of a video of a tracked take stood, its lens and its clock.
`annotate_film` writes the video's frames as labeled photographs. `detect_hands` writes the hands in pictures
as COCO keypoints; `HandDetector` finds them, and `train_detector` makes one from drawn pictures and your own.
"""

from typing import TYPE_CHECKING

from handsim import __version__ as __version__  # the first import: it warns about a package of the same name
from handsim._imports import lazy_exports

if TYPE_CHECKING:
    from film.annotation import annotate_film as annotate_film
    from film.annotation import register_camera as register_camera
    from film.detection import detect_hands as detect_hands
    from film.detector import FoundHand as FoundHand
    from film.detector import HandDetector as HandDetector
    from film.registration import Registration as Registration
    from film.stored_hands import StoredHands as StoredHands
    from film.training import train_detector as train_detector

__getattr__, __dir__ = lazy_exports(__name__)
