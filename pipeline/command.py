"""physics3d <verb> ...: what `make <verb>` does, from any folder, without make.

    physics3d run scene=carnation profile=smoke     the pipeline: as make run SCENE=carnation PROFILE=smoke
    physics3d why scene=carnation                   which stages that would compute, and what has changed
    physics3d sweep scenes=carnation,ball seeds=0,1 runner=dask          many runs at once (docs/clusters.md)
    physics3d ui [folder]                           MLflow's page of the runs recorded there
    physics3d graph [folder]                        Prefect's picture of the last run there
    physics3d collect [folder]                      remove the results that no run refers to
    physics3d pin|unpin learn/<fingerprint>         keep a result whatever is collected
    physics3d run --help                            every entry, scene, material, ...

Results go to the folder one stands in (output=<folder> elsewhere), and paths begin there; the configuration comes with
the package. The library needs nothing of this: the verbs are what the extra `pipeline` is for.
"""

import importlib
import os
import sys
from importlib.util import find_spec

VERBS = {
    "run": ("pipeline.__main__", []),
    "why": ("pipeline.why", []),
    "sweep": ("pipeline.sweep", []),
    "ui": ("pipeline.tracking", []),
    "graph": ("pipeline.graph", []),
    "collect": ("pipeline.shelf", ["collect"]),
    "pin": ("pipeline.shelf", ["pin"]),
    "unpin": ("pipeline.shelf", ["unpin"]),
}
NEEDED = ("hydra", "prefect", "mlflow")


def main(words: list[str] | None = None) -> int:
    """Exit codes are those of the verbs; 2 for a verb that does not exist, 1 for a package that is missing."""
    words = sys.argv[1:] if words is None else words
    if not words or words[0] in ("-h", "--help", "help"):
        print(__doc__)
        return 0
    if words[0] not in VERBS:
        print(f"error: no verb {words[0]!r}; there are {', '.join(VERBS)}", file=sys.stderr)
        return 2
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        print(f"error: {', '.join(missing)} not installed; pip install 'physics3d[pipeline]'", file=sys.stderr)
        return 1
    # torch's own threads spin beside those of the renderer and the simulator
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    module, first = VERBS[words[0]]
    return importlib.import_module(module).main([*first, *words[1:]])


if __name__ == "__main__":
    sys.exit(main())
