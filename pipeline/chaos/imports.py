"""What every life needs, done once by the server that lives are forked from: imports, and what is found out
about sources and options, which is the same in every life.
"""

from pathlib import Path

import matplotlib.pyplot  # noqa: F401

import pipeline.checks
import pipeline.stages.collect
import pipeline.track  # noqa: F401
from pipeline.config import load_config
from pipeline.loop import build_loop

build_loop(load_config(["experiment=soak"]), Path())
