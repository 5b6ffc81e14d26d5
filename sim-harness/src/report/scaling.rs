//! Classical multidimensional scaling: points of any dimension as points of the plane whose distances are as near as may be.

use nalgebra::{DMatrix, SymmetricEigen};

/// Points in the plane.
pub struct Plane {
    /// Coordinates of each point, in the units of its vector.
    pub points: Vec<[f64; 2]>,
    /// Share of the squared distances from the points' centre that the plane keeps, from 0 to 1; 1 where all points are one.
    pub kept: f64,
}

/// Reduces vectors of one length to the plane: the squared distances between them are centred on both sides, and the two eigenvectors with
/// the largest eigenvalues, times the roots of these, are the coordinates (Torgerson 1952).
///
/// An eigenvector's sign is free; here its largest coordinate is positive, so that the same vectors give the same picture.
pub fn plane(vectors: &[&[f32]]) -> Plane {
    let n = vectors.len();
    if n == 0 {
        return Plane {
            points: Vec::new(),
            kept: 1.0,
        };
    }
    let squared = DMatrix::from_fn(n, n, |i, j| distance_squared(vectors[i], vectors[j]));
    let centring = DMatrix::identity(n, n) - DMatrix::from_element(n, n, 1.0 / n as f64);
    let inner = -0.5 * (&centring * squared * &centring);
    let total = inner.trace();
    let eigen = SymmetricEigen::new(inner);
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let mut points = vec![[0.0; 2]; n];
    let mut held = 0.0;
    for (axis, &place) in order.iter().take(2).enumerate() {
        let value = eigen.eigenvalues[place].max(0.0);
        let column = eigen.eigenvectors.column(place);
        let sign = 1.0_f64.copysign(column[column.iamax()]);
        for (point, coordinate) in points.iter_mut().zip(column.iter()) {
            point[axis] = sign * value.sqrt() * coordinate;
        }
        held += value;
    }
    let kept = if total > 0.0 { held / total } else { 1.0 };
    Plane {
        points,
        kept: kept.min(1.0),
    }
}

fn distance_squared(a: &[f32], b: &[f32]) -> f64 {
    let differences = a.iter().zip(b).map(|(a, b)| f64::from(a - b));
    differences.map(|difference| difference * difference).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn distances(points: &[[f64; 2]]) -> Vec<f64> {
        let pairs = points
            .iter()
            .flat_map(|a| points.iter().map(move |b| (a, b)));
        pairs
            .map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]))
            .collect()
    }

    #[test]
    fn distances_in_a_plane_are_kept_wherever_it_lies() {
        let flat = [[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [-1.0, 2.5], [3.0, 0.0]];
        // Turned into five dimensions by two orthonormal vectors, and moved.
        let (u, v) = ([0.5, 0.5, 0.5, 0.5, 0.0], [0.5, -0.5, 0.5, -0.5, 0.0]);
        let lifted: Vec<Vec<f32>> = flat
            .iter()
            .map(|[x, y]| (0..5).map(|i| (x * u[i] + y * v[i] + 7.0) as f32).collect())
            .collect();
        let vectors: Vec<&[f32]> = lifted.iter().map(Vec::as_slice).collect();
        let found = plane(&vectors);
        assert!((found.kept - 1.0).abs() < 1e-6, "{}", found.kept);
        for (got, wanted) in distances(&found.points).iter().zip(distances(&flat)) {
            assert!((got - wanted).abs() < 1e-5, "{got} against {wanted}");
        }
    }

    #[test]
    fn what_has_more_dimensions_says_how_much_is_kept() {
        // The corners of a tetrahedron: three equal eigenvalues.
        let corners: [&[f32]; 4] = [
            &[1.0, 1.0, 1.0],
            &[1.0, -1.0, -1.0],
            &[-1.0, 1.0, -1.0],
            &[-1.0, -1.0, 1.0],
        ];
        let found = plane(&corners);
        assert!((found.kept - 2.0 / 3.0).abs() < 1e-9, "{}", found.kept);
    }

    #[test]
    fn one_point_and_none_have_a_place() {
        assert!(plane(&[]).points.is_empty());
        let same: [&[f32]; 3] = [&[1.0, 2.0]; 3];
        let found = plane(&same);
        assert_eq!((found.points, found.kept), (vec![[0.0; 2]; 3], 1.0));
    }
}
