"""Child processes that model buildings, so a bad building harms only itself.

*What happens when a child dies?* A child announces each building before it begins (`messages`), so `supervision` knows
which one it was. `isolated_items` tries that building once more, alone in a fresh child. If it fails again it is given
up: its record says `crashed`, `timed_out` or `out_of_memory`, and `replay_bundle` saves it for `gablework replay`. The
other buildings continue in a new child.

*Where do children come from?* `child_pool` keeps one per working thread. It forks them from a server that has loaded
libraries and kernels (`fork_server`, asked by `forked_child`), or starts new interpreters if the system cannot fork
(`spawned_child`). Each child runs `child_main`. `preloading` starts the server while a command still plans.
"""
