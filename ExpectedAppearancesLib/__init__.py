"""Registration of a surgical microscope view to preoperative MRI by learning Expected Appearances.

Method: Haouchine et al., "Learning Expected Appearances for Intraoperative Registration during Neurosurgery",
MICCAI 2023. One folder per stage: case -> poses -> masks -> appearances -> model -> registration -> evaluation.
"""

__version__ = "0.1.0"
