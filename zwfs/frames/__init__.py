"""Camera files to phase: `files` reads and writes, `registration` locates the pupils, `pipeline` reconstructs."""

from zwfs.frames import files, pipeline, registration

__all__ = ["files", "pipeline", "registration"]
