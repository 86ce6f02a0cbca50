// Stable radix sort of (key, value) pairs, four bits at a time:
//
//   count_digits  a workgroup for 2048 pairs: how many there are of each digit
//   scan          (scan.wgsl) where those of each digit and workgroup begin
//   scatter       a workgroup for the same pairs: to their places. Each invocation has eight pairs that follow each other,
//                 and 16 counters, two in a word, which are summed digit by digit over the workgroup

struct Step {
    shift: u32, count: u32, blocks: u32, numbers: u32,
}

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_values: array<u32>;
@group(0) @binding(5) var<storage, read_write> starts: array<u32>;  // of digit d in block b at d blocks + b

const ITEMS = 8u;
const BLOCK = 256u * ITEMS;

var<workgroup> digit_counts: array<atomic<u32>, 16>;
var<workgroup> counters: array<u32, BLOCK>;  // of digits d and d + 8, and invocation t, at 256 d + t
var<workgroup> first_of: array<u32, 8>;      // the counters of invocation 0, once they are sums

fn digit_of(key: u32) -> u32 {
    return (key >> step.shift) & 15u;
}

// How far up in its word the counter of a digit is.
fn half_of(digit: u32) -> u32 {
    return 16u * (digit >> 3u);
}

@compute @workgroup_size(256)
fn count_digits(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) group: vec3<u32>,
                @builtin(num_workgroups) groups: vec3<u32>) {
    let block = linear(group, groups);
    if (t < 16u) {
        atomicStore(&digit_counts[t], 0u);  // not every driver zeroes them
    }
    workgroupBarrier();
    for (var i = 0u; i < ITEMS; i++) {
        let at = block * BLOCK + i * 256u + t;
        if (at < step.count) {
            atomicAdd(&digit_counts[digit_of(keys[at])], 1u);
        }
    }
    workgroupBarrier();
    if (t < 16u && block < step.blocks) {
        starts[t * step.blocks + block] = atomicLoad(&digit_counts[t]);
    }
}

@compute @workgroup_size(256)
fn scatter(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) group: vec3<u32>,
           @builtin(num_workgroups) groups: vec3<u32>) {
    let block = linear(group, groups);
    let first = block * BLOCK + t * ITEMS;
    for (var i = 0u; i < 8u; i++) {
        counters[256u * i + t] = 0u;
    }
    for (var i = 0u; i < ITEMS; i++) {
        if (first + i < step.count) {
            let digit = digit_of(keys[first + i]);
            counters[256u * (digit & 7u) + t] += 1u << half_of(digit);
        }
    }
    workgroupBarrier();
    var mine = 0u;
    for (var i = 0u; i < 8u; i++) {
        mine += counters[8u * t + i];
    }
    var before = sum_before(mine, t);
    for (var i = 0u; i < 8u; i++) {
        let own = counters[8u * t + i];
        counters[8u * t + i] = before;
        before += own;
    }
    workgroupBarrier();
    if (t < 8u) {
        first_of[t] = counters[256u * t];
    }
    workgroupBarrier();
    for (var i = 0u; i < ITEMS; i++) {
        if (first + i < step.count) {
            let key = keys[first + i];
            let digit = digit_of(key);
            let half = half_of(digit);
            let cell = 256u * (digit & 7u) + t;
            let rank = ((counters[cell] >> half) & 0xffffu) - ((first_of[digit & 7u] >> half) & 0xffffu);
            counters[cell] += 1u << half;
            let place = starts[digit * step.blocks + block] + rank;
            sorted_keys[place] = key;
            sorted_values[place] = values[first + i];
        }
    }
}
