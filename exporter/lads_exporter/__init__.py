"""Trains LADS policies (Language-conditioned Discrete latent plans via semantic Skill abstractions) on demonstrations and exports each to
one ONNX file."""

__version__ = "0.1.0"
