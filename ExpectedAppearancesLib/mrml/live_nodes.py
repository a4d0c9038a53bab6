"""The nodes of the live panel, found again by the role that each has in an attribute."""

from __future__ import annotations

from pathlib import Path

from .scene import remove_node

ROLE_ATTRIBUTE = "ExpectedAppearances.Live"  # on every node of the live panel: its role
SEQUENCE_ATTRIBUTE = ROLE_ATTRIBUTE + ".Sequence"  # on every sequence of a recording: the role of what it plays into


def mark(node, role: str):
    node.SetAttribute(ROLE_ATTRIBUTE, role)
    return node


def node_of_role(scene, role: str):
    """The live node of that role, or None."""
    found = next((node for node in _nodes(scene) if node.GetAttribute(ROLE_ATTRIBUTE) == role), None)
    return found if found is not None else _played_into(scene, role)


def _played_into(scene, role: str):
    """The node that a recording plays into: of a loaded one Slicer copies the attributes too, and files keep none."""
    for browser in browsers(scene):
        for sequence in _nodes(scene):
            if sequence.GetAttribute(SEQUENCE_ATTRIBUTE) == role and browser.IsSynchronizedSequenceNodeID(
                sequence.GetID(), True
            ):
                node = browser.GetProxyNode(sequence)
                return None if node is None else mark(node, role)
    return None


def nodes_of_class(scene, kind: str) -> list:
    """In the order in which they were added."""
    found = scene.GetNodesByClass(kind)
    found.UnRegister(None)
    return [found.GetItemAsObject(i) for i in range(found.GetNumberOfItems())]


def browsers(scene) -> list:
    return nodes_of_class(scene, "vtkMRMLSequenceBrowserNode")


def is_recorded(scene, node) -> bool:
    """Whether a sequence browser plays into the node."""
    return any(browser.IsProxyNode(node.GetID()) for browser in browsers(scene))


def hide_another_case(scene, folder: Path) -> list:
    """Hide the models of the planning panel where it has another case than that in `folder` open: through the camera
    they would be seen over the picture of a patient who is not theirs. Returns those that were visible."""
    planning = scene.GetSingletonNode("ExpectedAppearances", "vtkMRMLScriptedModuleNode")
    planned = planning.GetParameter("casePath") if planning is not None else ""
    if not planned or Path(planned).absolute() == folder:
        return []
    nodes = [planning.GetNodeReference(role) for role in ("vesselsNode", "cortexModel")]
    hidden = [node for node in nodes if node is not None and node.GetDisplayVisibility()]
    for node in hidden:
        node.SetDisplayVisibility(False)
    return hidden


def remove_live_nodes(scene, but: tuple[str, ...] = ()) -> None:
    """Take the nodes with a role out of the scene, also those that a saved scene brought along.

    Those that a recording plays into stay, and those of the roles in `but`.
    """
    for node in _nodes(scene):
        role = node.GetAttribute(ROLE_ATTRIBUTE)
        if not role or role in but or not scene.IsNodePresent(node) or is_recorded(scene, node):
            continue
        remove_node(scene, node)


def _nodes(scene) -> list:
    collection = scene.GetNodes()
    return [collection.GetItemAsObject(i) for i in range(collection.GetNumberOfItems())]
