"""Reconstruction by a small network of our own: posed photographs in, signed distance and occupancy of a volume out.

The idea is NeuralRecon's (Sun et al., "NeuralRecon: Real-time coherent 3D reconstruction from monocular video", CVPR
2021); the volumes are dense, so that nothing but torch is needed, and small enough for one thread of a CPU.
"""
