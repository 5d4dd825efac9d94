"""The page: a study in the browser, for those who would rather look than write code.

``serve`` stands in ``phsi_opt.page.serve``. Three parts are kept apart: the session
(drafts and results, plain Python), the worker (a process of its own that solves) and
the views (NiceGUI, the extra ``app``; imported by them alone).
"""
