"""Objects in the panel of the viewer: a list by model with visibility, a filter of names, and the object selected."""

import contextlib
from collections import Counter
from html import escape

import numpy as np

from warp_abtree.app.cli.report import show_number

LISTED_OBJECTS = 40  # objects that are listed one by one, and models; the filter finds the others
NONE = "none"


class ObjectPanel:
    """Folder of the objects, made in a viser panel: which are `visible`, bool (n,), and which one is `selected`."""

    def __init__(self, gui, scene, objects, on_change):
        """Build the folder of `objects` of a scene; `on_change(handle, act)` acts on a value that the user set."""
        self._gui, self._scene, self._on_change = gui, scene, on_change
        self.visible, self.selected = np.ones(scene.object_count, bool), None
        self._models = np.array(scene.object_model)
        names = [scene.name(i) for i in objects.tolist()]
        seen = Counter(names)
        self._names = {i: name if seen[name] == 1 else f"{name} #{i}" for i, name in zip(objects.tolist(), names)}
        self._indices = {name: i for i, name in self._names.items()}
        with gui.add_folder("Selected object"):
            self._select = gui.add_dropdown("name", [NONE], hint="or click on an object")
            on_change(self._select, lambda name: self.select(self._indices.get(name)))
            self._told = gui.add_html("")
        self._parent = gui.add_folder("Objects", order=1e9)
        with self._parent:
            self._filter = gui.add_text("find", "", hint="a part of the name of an object or its model")
            on_change(self._filter, lambda _: self._list())
            self._folder, self._boxes = gui.add_folder("visible"), []
        self._list()

    def _list(self):
        """List the objects that the filter finds, by model, each with its visibility."""
        self._folder.remove()
        self._boxes, asked = [], self._filter.value.strip().lower()
        of_model: dict[int, list[int]] = {}
        for i, name in self._names.items():
            model = int(self._models[i])
            if asked in name.lower() or asked in self._scene.models[model].name.lower():
                of_model.setdefault(model, []).append(i)
        room, count = LISTED_OBJECTS, sum(len(members) for members in of_model.values())
        with self._parent:
            self._folder = self._gui.add_folder("visible")
        with self._folder:
            for model, members in list(of_model.items())[:LISTED_OBJECTS]:
                name = self._scene.models[model].name
                alone = len(members) == 1
                with contextlib.nullcontext() if alone else self._gui.add_folder(name, expand_by_default=room > 0):
                    if not alone:
                        self._add_box(f"all {len(members):,}", members)
                    for i in members[:room]:
                        self._add_box(self._names[i], [i])
                room = max(room - len(members), 0)
            if count > LISTED_OBJECTS or len(of_model) > LISTED_OBJECTS:
                self._gui.add_markdown(f"{LISTED_OBJECTS} of {count:,} are listed; **find** narrows the list.")
        self._offer()

    def _add_box(self, label, members):
        box = self._gui.add_checkbox(label, bool(self.visible[members].all()))
        self._boxes.append((box, members))
        self._on_change(box, lambda value: self.show(members, value))

    def show(self, members, value: bool):
        """Show or hide objects."""
        self.visible[members] = value
        for box, others in self._boxes:
            box.value = bool(self.visible[others].all())

    def select(self, i: int | None):
        """Select an object, or none."""
        self.selected = i
        self._offer()

    def _offer(self):
        """Offer the objects that are listed for selection, and the one that is selected."""
        offered = {self._names[members[0]] for _, members in self._boxes if len(members) == 1}
        name = NONE if self.selected is None else self._names[self.selected]
        self._select.options = [NONE, *sorted({*offered, name} - {NONE}, key=lambda name: self._indices[name])]
        self._select.value = name

    def tell(self, snapshot):
        """Tell what the selected object is, and with what it intersects in a snapshot."""
        i, scene = self.selected, self._scene
        if i is None:
            self._told.content = ""
            return
        model, lod, result = scene.models[self._models[i]], int(snapshot.lods[i]), snapshot.result
        meets = np.flatnonzero((result.pairs == i).any(axis=1) & result.any)
        met = [f"{self._names[int(result.pairs[k].sum() - i)]} ({result.count[k]:,} face pairs)" for k in meets[:8]]
        lines = [
            ("model", model.name),
            ("LOD", f"{lod:,} of {model.lod_max:,}"),
            ("faces", f"{model.progressive.active_count(lod):,} of {model.face_count:,}"),
            ("position", " ".join(show_number(x) for x in snapshot.poses[i, :3])),
            (f"meets {len(meets):,}", ", ".join(met) + (", ..." if len(meets) > len(met) else "")),
        ]
        rows = "".join(f"<tr><td>{escape(key)}</td><td>{escape(value)}</td></tr>" for key, value in lines)
        self._told.content = f"<table style='font-size:0.85em;margin:0 1em'>{rows}</table>"
