"""Programs that measure speed. Each runs as the engine runs a stage: the same threads, the same way of waiting."""

from hugs_cli.cache.child import prepare

prepare()
