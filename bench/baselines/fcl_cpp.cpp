// FCL in C++ as a baseline: two meshes, B at many poses, the loop over them on this side. See fcl_cpp.py.
#include <cstdint>
#include <memory>
#include <vector>

#include <fcl/fcl.h>

namespace {

using Tree = fcl::BVHModel<fcl::OBBRSSd>;

std::shared_ptr<Tree> make_tree(const double* vertices, int64_t vertex_count, const int32_t* faces,
                                int64_t face_count) {
    std::vector<fcl::Vector3d> points;
    std::vector<fcl::Triangle> triangles;
    for (int64_t i = 0; i < vertex_count; ++i) {
        points.emplace_back(vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]);
    }
    for (int64_t i = 0; i < face_count; ++i) {
        triangles.emplace_back(faces[3 * i], faces[3 * i + 1], faces[3 * i + 2]);
    }
    auto tree = std::make_shared<Tree>();
    tree->beginModel(static_cast<int>(face_count), static_cast<int>(vertex_count));
    tree->addSubModel(points, triangles);
    tree->endModel();
    return tree;
}

struct Baseline {
    fcl::CollisionObjectd a;
    std::vector<fcl::CollisionObjectd> b;
    std::vector<fcl::CollisionResultd> results;
};

}  // namespace

extern "C" {

// Matrices are (pose_count, 4, 4), row by row. Without vertices_b, B is A's mesh.
void* fcl_baseline_make(const double* vertices_a, int64_t vertex_count_a, const int32_t* faces_a, int64_t face_count_a,
                    const double* vertices_b, int64_t vertex_count_b, const int32_t* faces_b, int64_t face_count_b,
                    const double* matrices, int64_t pose_count) {
    auto tree_a = make_tree(vertices_a, vertex_count_a, faces_a, face_count_a);
    auto tree_b = vertices_b ? make_tree(vertices_b, vertex_count_b, faces_b, face_count_b) : tree_a;
    auto* baseline = new Baseline{fcl::CollisionObjectd(tree_a), {}, {}};
    for (int64_t i = 0; i < pose_count; ++i) {
        const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> matrix(matrices + 16 * i);
        baseline->b.emplace_back(tree_b, fcl::Matrix3d(matrix.topLeftCorner<3, 3>()),
                             fcl::Vector3d(matrix.topRightCorner<3, 1>()));
    }
    return baseline;
}

void fcl_baseline_free(void* handle) { delete static_cast<Baseline*>(handle); }

// Whether B intersects A at each pose: found[pose_count].
void fcl_baseline_any(void* handle, uint8_t* found) {
    auto* baseline = static_cast<Baseline*>(handle);
    const fcl::CollisionRequestd request;
    for (size_t i = 0; i < baseline->b.size(); ++i) {
        fcl::CollisionResultd result;
        fcl::collide(&baseline->a, &baseline->b[i], request, result);
        found[i] = result.isCollision();
    }
}

// Find all face pairs, without points of contact, and keep them: their number at each pose.
void fcl_baseline_faces(void* handle, int64_t* count) {
    auto* baseline = static_cast<Baseline*>(handle);
    fcl::CollisionRequestd request;
    request.num_max_contacts = INT32_MAX;
    baseline->results.clear();
    baseline->results.resize(baseline->b.size());
    for (size_t i = 0; i < baseline->b.size(); ++i) {
        fcl::collide(&baseline->a, &baseline->b[i], request, baseline->results[i]);
        count[i] = static_cast<int64_t>(baseline->results[i].numContacts());
    }
}

// The face pairs kept of one pose: pairs[2 * count].
void fcl_baseline_pairs(void* handle, int64_t pose, int64_t* pairs) {
    const auto& result = static_cast<Baseline*>(handle)->results[pose];
    for (size_t k = 0; k < result.numContacts(); ++k) {
        pairs[2 * k] = result.getContact(k).b1;
        pairs[2 * k + 1] = result.getContact(k).b2;
    }
}

}  // extern "C"
