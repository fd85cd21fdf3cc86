"""Control groups of this process (a container, a batch system, a service), as Linux reports them."""

from pathlib import Path


def group_folders(root: Path, controller: str) -> list[Path]:
    """Return the folders of the control groups that limit this process, innermost first.

    A group's limit holds for all groups in it. In a container the path of the group may be that of the host, whose
    folders do not exist. Then the limit is at the top.

    Args:
      root: root of the file system, with proc/self/cgroup and sys/fs/cgroup.
      controller: "cpu" or "memory".
    """
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    folders: list[Path] = []
    for _, controllers, path in (line.split(":", 2) for line in lines if line.count(":") >= 2):
        top = root / "sys/fs/cgroup" / controllers
        if controllers and controller not in controllers.split(","):
            continue
        here = top / path.lstrip("/")
        folders += [folder for folder in (here, *here.parents) if folder.is_relative_to(top)]
    return folders
