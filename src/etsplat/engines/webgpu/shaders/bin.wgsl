// The list of (triangle, tile) pairs, which are called slots, in drawing order:
//
//   slot_totals  a workgroup for 1024 ranks of the depth order: how many slots they have; scan.wgsl says where they begin
//   emit         a workgroup for the same ranks: writes them
//   ranges       an invocation per slot, after they were sorted by tile: where each tile begins and ends

@group(0) @binding(0) var<uniform> view: Pass;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;
@group(0) @binding(4) var<storage, read> records: array<Record>;
@group(0) @binding(5) var<storage, read_write> slot_tile: array<u32>;
@group(0) @binding(6) var<storage, read_write> slot_triangle: array<u32>;
@group(0) @binding(7) var<storage, read_write> tile_ranges: array<vec2<u32>>;

const RANKS = 4u;  // of an invocation

fn count_at(rank: u32) -> u32 {
    if (rank >= view.triangles) {
        return 0u;
    }
    return counts[order[rank]];
}

@compute @workgroup_size(256)
fn slot_totals(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) group: vec3<u32>,
               @builtin(num_workgroups) groups: vec3<u32>) {
    let block = linear(group, groups);
    var mine = 0u;
    for (var i = 0u; i < RANKS; i++) {
        mine = added(mine, count_at((256u * block + t) * RANKS + i));
    }
    sum_before(mine, t);
    if (t == 0u && block * 256u * RANKS < view.triangles) {
        totals[block] = scanned[255];
    }
}

// Counted with the record still in registers, a pair on the edge of the test's slack may be found otherwise here: no more
// are written than were counted, and those that miss go to a tile behind the last.
fn write_slots(i: u32, first: u32, count: u32) {
    let record = records[i];
    let search = tile_search(record, view.width, view.height);
    var found = 0u;
    for (var row = search.top; row < search.top + search.rows; row++) {
        for (var column = search.left; column < search.left + search.columns; column++) {
            if (found < count && touches(record, search.slack, column, row)) {
                slot_tile[first + found] = row * view.tiles_x + column;
                slot_triangle[first + found] = i;
                found++;
            }
        }
    }
    for (; found < count; found++) {
        slot_tile[first + found] = view.tiles_x * view.tiles_y;
        slot_triangle[first + found] = i;
    }
}

@compute @workgroup_size(256)
fn emit(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) group: vec3<u32>,
        @builtin(num_workgroups) groups: vec3<u32>) {
    let block = linear(group, groups);
    let first_rank = (256u * block + t) * RANKS;
    var mine = 0u;
    for (var i = 0u; i < RANKS; i++) {
        mine += count_at(first_rank + i);
    }
    let before = sum_before(mine, t);
    if (first_rank >= view.triangles) {
        return;
    }
    var slot = totals[block] + before;
    for (var i = 0u; i < RANKS; i++) {
        let count = count_at(first_rank + i);
        if (count > 0u) {
            write_slots(order[first_rank + i], slot, count);
            slot += count;
        }
    }
}

@compute @workgroup_size(256)
fn ranges(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) group: vec3<u32>,
          @builtin(num_workgroups) groups: vec3<u32>) {
    let i = linear(group, groups) * 256u + t;
    if (i >= view.slots) {
        return;
    }
    let tile = slot_tile[i];
    if (tile >= view.tiles_x * view.tiles_y) {
        return;
    }
    if (i == 0u || slot_tile[i - 1u] != tile) {
        tile_ranges[tile].x = i;
    }
    if (i + 1u == view.slots || slot_tile[i + 1u] != tile) {
        tile_ranges[tile].y = i + 1u;
    }
}
