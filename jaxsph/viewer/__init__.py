"""An interactive view: what is looked at, how it is rendered while it moves and once it stands, and who shows it.

Flow: scene, camera -> Session (a pose, a look, threads that render the newest of it) -> pictures -> server and page, or a widget.
"""
