"""Demonstrations to a LADS policy (Language-conditioned Discrete latent plans via semantic Skill abstractions) to one ONNX file."""

__version__ = "0.1.0"
