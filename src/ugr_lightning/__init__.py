"""Train, evaluate and understand action-chunking robot policies with uncertainty-guided sparse refinement."""

__version__ = "0.1.0"
