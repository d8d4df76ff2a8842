"""What every life needs, imported once by the server that lives are forked from."""

import pipeline.checks
import pipeline.config
import pipeline.loop
import pipeline.stages.collect
import pipeline.track  # noqa: F401
