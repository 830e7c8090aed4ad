// Sizes that native code and kernels share; `native.constant` reads them, one literal a line.
#pragma once

constexpr int WARP_SIZE = 32;

// A warp's items in shared memory: node pairs, then leaf pairs, then straddling pairs and their signs, then slab
// pairs: node pairs that wait for slabs.
// With what Warp and the driver add, 16 warps fit into 132 KiB of a multiprocessor.
constexpr int STACK_LENGTH = 512;
constexpr int LEAF_PAIR_LENGTH = 160;
constexpr int STRADDLING_LENGTH = 64;
constexpr int STRADDLING_START = 672;
constexpr int SIGNS_START = 736;
constexpr int SLAB_PAIR_LENGTH = 144;
constexpr int SLAB_PAIR_START = 768;
static_assert((STACK_LENGTH & (STACK_LENGTH - 1)) == 0, "the stack is a ring");
static_assert(LEAF_PAIR_LENGTH >= (WARP_SIZE - 1) + 4 * WARP_SIZE, "fewer than a warp wait, a test emits 4 a lane");
static_assert(STRADDLING_LENGTH >= (WARP_SIZE - 1) + WARP_SIZE, "fewer than a warp wait, a test adds 1 a lane");
static_assert(STRADDLING_START == STACK_LENGTH + LEAF_PAIR_LENGTH, "lists lie one behind the other");
static_assert(SIGNS_START == STRADDLING_START + STRADDLING_LENGTH, "signs lie behind the straddling pairs");
static_assert(SLAB_PAIR_START == SIGNS_START + STRADDLING_LENGTH / 2, "two signs an entry");
static_assert(SLAB_PAIR_LENGTH >= WARP_SIZE + 4, "fewer than a warp wait, a test emits 4");
// Lists are named by the shifts at which `push_children` packs three places [bytes] into a word. The last, on the
// stack, goes round.
constexpr int SLAB_PAIR_LIST = 0;
constexpr int LEAF_PAIR_LIST = 10;
constexpr int STACK_LIST = 20;
constexpr int NO_LIST = 32;
constexpr int ITEM_BYTES = 8;
constexpr int PLACE_MASK = 8184;
static_assert(PLACE_MASK == ITEM_BYTES * ((1 << LEAF_PAIR_LIST) - 1), "the bits of a place, whole items");
static_assert(ITEM_BYTES * (SLAB_PAIR_START + SLAB_PAIR_LENGTH) <= PLACE_MASK, "places fit");
static_assert(STACK_LIST == 2 * LEAF_PAIR_LIST, "places do not overlap");
static_assert((unsigned int)(ITEM_BYTES * STACK_LENGTH) << STACK_LIST == 0, "the stack is a ring in the word, too");

// Two small trees where a warp's stack lies otherwise: boxes and corners of faces of A and B, three quarters of 4 words
// each, the leaves of each tree, and face pairs and hits, half a word each. The inner nodes come first, where boxes
// take their place. Places are words of 4 bytes, but for TILE_PAIRS and TILE_HITS, which are half words.
constexpr int TILE_FACES = 32;
constexpr int TILE_WORDS = 384;
constexpr int TILE_CORNERS = 768;
constexpr int SMALL_LEAVES = 96;
constexpr int SMALL_INNER = 192;
constexpr int SMALL_A = 1536;
constexpr int SMALL_B = 1632;
constexpr int TILE_PAIRS = 3456;
constexpr int TILE_HITS = 3520;
constexpr int TILE_HITS_LENGTH = 63;
static_assert(TILE_FACES == WARP_SIZE && TILE_WORDS == 12 * TILE_FACES, "a face of A is a bit, one of B a lane");
static_assert(TILE_CORNERS == 2 * TILE_WORDS && SMALL_A == 4 * TILE_WORDS, "boxes of A and B, corners of A and B");
static_assert(SMALL_INNER >= 2 * SMALL_LEAVES && TILE_WORDS >= SMALL_INNER, "both trees' inner nodes have room");
static_assert(SMALL_B == SMALL_A + SMALL_LEAVES && TILE_PAIRS == 2 * (SMALL_B + SMALL_LEAVES), "no gap");
static_assert(TILE_HITS - TILE_PAIRS >= (WARP_SIZE - 1) + WARP_SIZE, "fewer than a warp wait, each lane adds one");
static_assert(TILE_HITS_LENGTH >= (WARP_SIZE - 1) + WARP_SIZE, "fewer than a warp wait, each lane adds one");
static_assert(2 * (TILE_HITS + TILE_HITS_LENGTH) <= ITEM_BYTES * (SLAB_PAIR_START + SLAB_PAIR_LENGTH), "room");

// Of a search for the nearest faces: node pairs, face pairs for float32, and behind them those for float64.
constexpr int NEAREST_OPEN_START = 672;
constexpr int NEAREST_OPEN_LENGTH = 64;
constexpr int NEAREST_LENGTH = 736;
// Margins of boxes that a bound by slabs leaves off, of twice the distance (docs/exactness.md, bounds 17 and 18).
constexpr int SLAB_MARGINS = 10;
static_assert(NEAREST_OPEN_START == STACK_LENGTH + LEAF_PAIR_LENGTH, "lists lie one behind the other");
static_assert(NEAREST_LENGTH == NEAREST_OPEN_START + NEAREST_OPEN_LENGTH, "lists lie one behind the other");

// A warp's search for first contacts: node pairs, face pairs that wait, and those that go on; object pairs at once.
constexpr int MOTION_STACK_LENGTH = 704;
constexpr int MOTION_GOING_START = 864;
constexpr int MOTION_LENGTH = 928;
constexpr int MOTION_TIMES_START = 1392;
constexpr int MOTION_WORDS = 1572;
constexpr int MOTION_GROUP = 4;
static_assert(MOTION_GOING_START == MOTION_STACK_LENGTH + LEAF_PAIR_LENGTH, "lists lie one behind the other");
static_assert(MOTION_LENGTH == MOTION_GOING_START + 2 * WARP_SIZE, "fewer than a warp go on, each lane adds one");
static_assert(2 * MOTION_TIMES_START == 3 * MOTION_LENGTH, "bounds lie behind the items");
static_assert(MOTION_WORDS == MOTION_TIMES_START + 2 * WARP_SIZE + MOTION_LENGTH / 8, "then times, then slots");

// Warps of a block that resolves uncertain face pairs: fewer blocks start sooner where there are none.
constexpr int RESOLVE_WARPS = 4;

// Slots of the queue in which idle warps wait, each with room for so many items: one a lane.
// More than there are units of any launch: as the number of units taken, it leaves none.
constexpr int NO_UNIT = 1073741824;
constexpr int SLOT_COUNT = 8192;
constexpr int SLOT_ITEMS = 32;
static_assert((SLOT_COUNT & (SLOT_COUNT - 1)) == 0, "a ticket's low bits are its slot");
static_assert(SLOT_COUNT % (4 * WARP_SIZE) == 0, "flags are written four a lane");
static_assert(SLOT_ITEMS == WARP_SIZE, "a lane moves one item");

// The CPU: node pairs taken at once, and the stack's length. Depth first leaves three items a level, 31 levels deep; a
// node pair test writes over four more, and divisions round.
constexpr int ITEMS_AT_ONCE = 64;
constexpr int CPU_STACK_LENGTH = 1024;
constexpr int DEPTH_FIRST_LENGTH = 101;
static_assert(DEPTH_FIRST_LENGTH == 3 * 31 + 8, "depth first always fits");
static_assert(CPU_STACK_LENGTH >= DEPTH_FIRST_LENGTH + 4 * ITEMS_AT_ONCE, "so many at once fit at the start");

// Subtrees of which the CPU keeps slabs: levels below the root and leaves; faces of which it takes normals.
constexpr int SUBTREE_DEPTH = 7;
constexpr int SUBTREE_LEAVES = 128;
constexpr int SUBTREE_RECORDS = 256;
constexpr int SLAB_SAMPLES = 64;
constexpr int SLAB_HEADER = 256;
constexpr int SUBTREES_AT_ONCE = 16;
constexpr int NO_FLOOR = 64;
static_assert(SUBTREE_LEAVES == 1 << SUBTREE_DEPTH, "of a binary tree");
static_assert(SUBTREE_RECORDS == 2 * SUBTREE_LEAVES, "one a node, by its place in the subtree");

// A search for the nearest faces on the CPU: node pairs that wait for later, faces for float64, faces for float32, node
// pairs taken at once, faces measured from which on slabs are compared along the nodes' normals, and words of a thread.
constexpr int LATER_LENGTH = 4096;
constexpr int OPEN_LENGTH = 256;
constexpr int NEAREST_FACES = 128;
constexpr int NEAREST_AT_ONCE = 8;
constexpr int NORMALS_LEAST = 4096;
constexpr int NEAREST_WORDS = 16400;
static_assert(NEAREST_FACES >= 15 + 4 * NEAREST_AT_ONCE + 16 && NEAREST_AT_ONCE % 4 == 0, "loads go beyond");
static_assert(NEAREST_WORDS == 16 + 3 * (CPU_STACK_LENGTH + LATER_LENGTH + OPEN_LENGTH) + 2 * NEAREST_FACES, "no gap");

// Straddling pairs that wait for their last two signs on the CPU, the last 16 of them written over.
constexpr int STRADDLING_ROOM = 256;
static_assert(STRADDLING_ROOM % 8 == 0, "corners are found 8 at a time");

// An update by one block: two counters, then a bit for each node of a tree at most so deep, and another for each inner
// node.
constexpr int BLOCK_DEPTH = 16;
constexpr int MARK_START = 64;
constexpr int MARK_WORDS = 6146;
// Less for shallow trees, so that more blocks run at a time.
constexpr int SHALLOW_DEPTH = 13;
constexpr int SHALLOW_WORDS = 770;
static_assert(32 * SHALLOW_WORDS == MARK_START + 3 * (1 << SHALLOW_DEPTH), "all marks have room");
static_assert(MARK_START % 32 == 0 && 32 * MARK_WORDS == MARK_START + 3 * (1 << BLOCK_DEPTH), "all marks have room");

constexpr int UNCERTAIN = 8;
constexpr double COORDINATE_MIN = 0x1p-290;
constexpr double BOUND_3D = 0x1.0000000000008p-50;
constexpr double BOUND_2D = 0x1.8000000000004p-52;
constexpr double BOUND_DOUBLE = 0x1p-100;
constexpr double RELATIVE_ERROR = 0x1p-42;
constexpr double SHORTEST_NORMAL = 0x1p-20;
constexpr double LEAST_SEPARATION = 0x1p-126;
constexpr double CLOSEST = 0x1p-60;
constexpr double ALONG = 0x1.fef9db22d0e56p-1;
constexpr double NO_DISTANCE = 0x1p-30;
constexpr int CHUNK = 32;

// Twists by which contact points are chosen, one a thread of a block: random ones, then turns about lines at the rim.
constexpr int TWIST_COUNT = 256;
constexpr int RANDOM_TWISTS = 192;
static_assert(RANDOM_TWISTS % 32 == 0 && TWIST_COUNT % 32 == 0, "vectors and halves of turns are whole");

// Slots of the contact witnesses of an object pair: bins of normals, of each the deepest and the farthest in eight
// directions, of what crosses and of what is apart, and the deepest of what is apart inside.
constexpr int NORMAL_BINS = 20;
constexpr int SCORES = 9;
constexpr int SLOTS_A_BIN = 19;
constexpr int SLOT_ROOM = 380;
// Corners of a triangle within the column of another, at most: candidates of a witness.
constexpr int COLUMN_CORNERS = 6;
static_assert(SLOTS_A_BIN == 2 * SCORES + 1, "no gap");
static_assert(SLOT_ROOM == NORMAL_BINS * SLOTS_A_BIN, "no gap");

// Certified errors: faces about a merge, distances of corners to them, corners of a polygon, polygons on the stack,
// faces that cover a triangle, cuts of one, and triangles covered at once.
constexpr int NEAR_ROOM = 64;
constexpr int DISTANCE_ROOM = 8192;
constexpr int POLYGON_CORNERS = 16;
constexpr int POLYGON_STACK = 64;
constexpr int COVER_SLOTS = 32;
constexpr int COVER_CUTS = 64;
constexpr int COVERS_AT_ONCE = 64;
constexpr int SLOT_FACE = 0;
constexpr int SLOT_TRIANGLE = 1;
constexpr int SLOT_SIBLING = 2;
constexpr int SLOT_NEXT = 3;
constexpr int SLOT_FIELDS = 8;
static_assert(NEAR_ROOM % 8 == 0 && DISTANCE_ROOM >= 64 * NEAR_ROOM, "8 faces a vector, and room for cuts");

// Expansions in 3D: 6 products of three differences, each of two components, and each product of three of four. So many
// lanes of a warp have room for one in shared memory.
constexpr int EXPANSION_LENGTH = 192;
constexpr int EXPANSION_LANES = 16;

// Hits sorted by object pair: threads of a block, and keys that each has room for twice in shared memory.
constexpr int SEGMENT_THREADS = 256;
constexpr int SEGMENT_KEYS = 8;
static_assert(2 * SEGMENT_KEYS * SEGMENT_THREADS * 8 <= 32768, "7 blocks fit into a multiprocessor");
