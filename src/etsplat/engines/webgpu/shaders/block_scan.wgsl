// Sums over a workgroup of 256, by barriers alone: no subgroups, no waiting for other workgroups.

var<workgroup> scanned: array<u32, 256>;

// Stays at the largest number, so that the host sees when there are too many.
fn added(a: u32, b: u32) -> u32 {
    return min(a, 0xffffffffu - b) + b;
}

// The sum of `mine` over the invocations before this one; afterwards scanned[255] is the sum over all of them.
fn sum_before(mine: u32, t: u32) -> u32 {
    workgroupBarrier();
    scanned[t] = mine;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        var other = 0u;
        if (t >= step) {
            other = scanned[t - step];
        }
        workgroupBarrier();
        scanned[t] = added(scanned[t], other);
        workgroupBarrier();
    }
    return scanned[t] - mine;
}
