"""trimesh: two CollisionManagers of one object each, which hold python-fcl's trees; B is moved for each pose."""


class Trimesh:
    name = "trimesh"

    def __init__(self, a, b, matrices):
        import fcl  # noqa: F401 - trimesh has its managers from it
        import trimesh
        from trimesh.collision import CollisionManager

        self.a, self.b, self.matrices = CollisionManager(), CollisionManager(), matrices
        self.a.add_object("a", trimesh.Trimesh(*a, process=False))
        self.b.add_object("b", trimesh.Trimesh(*b, process=False))

    def _collide(self, **wanted):
        answers = []
        for matrix in self.matrices:
            self.b.set_transform("b", matrix)
            answers.append(self.a.in_collision_other(self.b, **wanted))
        return answers

    def any(self):
        return self._collide()

    def faces(self):
        return self._collide(return_data=True)

    @staticmethod
    def face_pairs(answer):
        return [(contact.index("a"), contact.index("b")) for contact in answer[1]]
