"""The loop: compare, diagnose, add, watch the error fall."""

from phsi_opt.study.study import Study

__all__ = ["Study"]
