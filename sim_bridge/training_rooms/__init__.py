"""Rooms as lessons for the learned reconstructor: photographs with poses, and where the surfaces really are."""
