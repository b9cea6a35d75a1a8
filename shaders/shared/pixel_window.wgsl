// The 11-tap Gaussian window (σ = 1.5 pixels) of SSIM (Wang et al. 2004), zero beyond the image, and the tiling that both loss
// passes share: a workgroup of 16×16 with a border of 5.
const RADIUS: u32 = 5u;
const SPAN: u32 = 26u;
const WINDOW = array<f32, 11>(
    0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300553, 0.26601172, 0.21300553, 0.10936069, 0.03600077, 0.00759876, 0.00102838,
);
