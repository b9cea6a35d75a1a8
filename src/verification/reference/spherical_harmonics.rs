//! Real spherical harmonics as polynomials: values and gradients from one table of monomials.

use nalgebra::Vector3;

/// coefficient · x^a · y^b · z^c
type Monomial = (f64, [i32; 3]);

fn monomials(k: usize) -> Vec<Monomial> {
    const C1: f64 = 0.488_602_511_902_919_9;
    const C2: [f64; 3] = [1.092_548_430_592_079_2, 0.315_391_565_252_520_05, 0.546_274_215_296_039_6];
    const C3: [f64; 5] =
        [0.590_043_589_926_643_5, 2.890_611_442_640_554, 0.457_045_799_464_465_8, 0.373_176_332_590_115_4, 1.445_305_721_320_277];
    let scaled = |factor: f64, terms: &[Monomial]| terms.iter().map(|(c, e)| (factor * c, *e)).collect();
    match k {
        0 => vec![(0.282_094_791_773_878_14, [0, 0, 0])],
        1 => vec![(-C1, [0, 1, 0])],
        2 => vec![(C1, [0, 0, 1])],
        3 => vec![(-C1, [1, 0, 0])],
        4 => vec![(C2[0], [1, 1, 0])],
        5 => vec![(-C2[0], [0, 1, 1])],
        6 => scaled(C2[1], &[(2.0, [0, 0, 2]), (-1.0, [2, 0, 0]), (-1.0, [0, 2, 0])]),
        7 => vec![(-C2[0], [1, 0, 1])],
        8 => scaled(C2[2], &[(1.0, [2, 0, 0]), (-1.0, [0, 2, 0])]),
        9 => scaled(-C3[0], &[(3.0, [2, 1, 0]), (-1.0, [0, 3, 0])]),
        10 => vec![(C3[1], [1, 1, 1])],
        11 => scaled(-C3[2], &[(4.0, [0, 1, 2]), (-1.0, [2, 1, 0]), (-1.0, [0, 3, 0])]),
        12 => scaled(C3[3], &[(2.0, [0, 0, 3]), (-3.0, [2, 0, 1]), (-3.0, [0, 2, 1])]),
        13 => scaled(-C3[2], &[(4.0, [1, 0, 2]), (-1.0, [3, 0, 0]), (-1.0, [1, 2, 0])]),
        14 => scaled(C3[4], &[(1.0, [2, 0, 1]), (-1.0, [0, 2, 1])]),
        15 => scaled(-C3[0], &[(1.0, [3, 0, 0]), (-3.0, [1, 2, 0])]),
        _ => unreachable!("degree 3 has 16 basis functions"),
    }
}

/// Basis function `k` in the unit direction `d`.
pub fn basis(k: usize, d: &Vector3<f64>) -> f64 {
    monomials(k).iter().map(|(c, e)| c * d.x.powi(e[0]) * d.y.powi(e[1]) * d.z.powi(e[2])).sum()
}

/// Its gradient by `d`, as if `d` were free.
pub fn basis_gradient(k: usize, d: &Vector3<f64>) -> Vector3<f64> {
    let mut gradient = Vector3::zeros();
    for (c, e) in monomials(k) {
        for axis in 0..3 {
            if e[axis] > 0 {
                let power = |i: usize| d[i].powi(e[i] - i32::from(i == axis));
                gradient[axis] += c * f64::from(e[axis]) * power(0) * power(1) * power(2);
            }
        }
    }
    gradient
}
