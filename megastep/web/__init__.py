"""Environments outside Python: what a step launches, recorded, and replayed elsewhere with the same
bits.

:func:`~megastep.web.recording.record` turns an environment into a
:class:`~megastep.web.program.Program`: lists of launches, and the memory that they read and write.
:func:`~megastep.web.page.page` makes an HTML file of one, where WebAssembly runs it.
"""
