// Which tiles a triangle touches: those that meet its box and pass the separating-axis test.

struct Search {
    left: u32, top: u32, columns: u32, rows: u32,
    slack: vec3<f32>,
}

const REACH = 0.5 * f32(TILE - 1u);

fn tile_search(record: Record, width: u32, height: u32) -> Search {
    let w = f32(width);
    let h = f32(height);
    let q = record.place.xy;
    let x0 = ceil(clamp(q.x + record.box.x - 0.5, 0.0, w));
    let x1 = floor(clamp(q.x + record.box.y - 0.5, -1.0, w - 1.0));
    let y0 = ceil(clamp(q.y + record.box.z - 0.5, 0.0, h));
    let y1 = floor(clamp(q.y + record.box.w - 0.5, -1.0, h - 1.0));
    var search = Search();
    if (x0 <= x1 && y0 <= y1) {
        search.left = u32(x0) / TILE;
        search.top = u32(y0) / TILE;
        search.columns = u32(x1) / TILE - search.left + 1u;
        search.rows = u32(y1) / TILE - search.top + 1u;
    }
    search.slack = vec3(record.place.z * (1.0 + 1e-5) + 1e-5) + REACH * (abs(record.gx.xyz) + abs(record.gy.xyz));
    return search;
}

fn touches(record: Record, slack: vec3<f32>, column: u32, row: u32) -> bool {
    let x = f32(column * TILE) + (0.5 + REACH) - record.place.x;
    let y = f32(row * TILE) + (0.5 + REACH) - record.place.y;
    return all(record.gx.xyz * x + record.gy.xyz * y <= slack);
}
