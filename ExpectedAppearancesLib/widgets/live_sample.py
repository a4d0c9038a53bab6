"""The sample in Slicer's Sample Data: a generated phantom, made on this computer, that runs the panel in one click."""

from __future__ import annotations

from pathlib import Path

import qt
import slicer
from slicer.i18n import tr as _

from ..errors import ExpectedAppearancesError
from ..live.choice import SourceKind
from .live_panel import LivePanel

FOLDER_NAME = "ExpectedAppearancesPhantom"
RATE_HZ = 12.0


def folder() -> Path:
    """Where the sample is kept, so that it is made only once."""
    return Path(slicer.mrmlScene.GetCacheManager().GetRemoteCacheDirectory()) / FOLDER_NAME


def make_sample(where: Path) -> tuple[Path, Path]:
    """Make the phantom's case and frames where they are not there yet; paths of the case and of the frames."""
    from ..demo.phantom import make_phantom, write_sample_frames

    phantom = make_phantom(where / "case")
    write_sample_frames(phantom, where / "frames")
    return where / "case", where / "frames"


def run_sample(panel: LivePanel) -> bool:
    """Make the sample and start the panel on it. False, and the reason in the panel, when it cannot be started."""
    parameters = panel.parameters()
    qt.QApplication.setOverrideCursor(qt.Qt.WaitCursor)
    try:
        slicer.util.showStatusMessage(_("Generating the phantom ..."))
        case, frames = make_sample(folder())
    except ImportError as error:
        panel.say(_("The sample needs more than this Slicer has ({error}); install it below.").format(error=error))
        return False
    except ExpectedAppearancesError as error:
        panel.say(str(error))
        return False
    finally:
        slicer.util.showStatusMessage("")
        qt.QApplication.restoreOverrideCursor()
    panel.stop()
    parameters.casePath, parameters.sourcePath = str(case), str(frames)
    parameters.sourceKind = SourceKind.PATH.value
    parameters.cameraPath = ""
    parameters.cropBorders = parameters.flipRows = False  # the sample's frames are as they should be
    parameters.repeat, parameters.onlyNew, parameters.rateHz = True, False, RATE_HZ
    panel.refresh()
    return panel.start()
