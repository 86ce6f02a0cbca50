// One workgroup replaces numbers by the sum of those before them, 1024 at a time; the sum of all goes behind the last.

struct Step {
    shift: u32, count: u32, blocks: u32, numbers: u32,
}

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read_write> sums: array<u32>;

@compute @workgroup_size(256)
fn scan(@builtin(local_invocation_index) t: u32) {
    var total = 0u;
    for (var first = 0u; first < step.numbers; first += 1024u) {
        var own = array<u32, 4>();  // without this it keeps what it had the last time, in some compilers
        var mine = 0u;
        for (var i = 0u; i < 4u; i++) {
            let at = first + 4u * t + i;
            if (at < step.numbers) {
                own[i] = sums[at];
            }
            mine = added(mine, own[i]);
        }
        var before = added(total, sum_before(mine, t));
        for (var i = 0u; i < 4u; i++) {
            let at = first + 4u * t + i;
            if (at < step.numbers) {
                sums[at] = before;
            }
            before = added(before, own[i]);
        }
        total = added(total, scanned[255]);
    }
    if (t == 0u) {
        sums[step.numbers] = total;
    }
}
