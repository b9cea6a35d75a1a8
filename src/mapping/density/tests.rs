use super::*;
use crate::render::layout::VERDICT_KEEP;

/// A verdict with a score, of a Gaussian that some view has blended.
fn word(verdict: u32, score: f32) -> u32 {
    (score.to_bits() & !VERDICT_BITS) | verdict | SEEN
}

fn growing(max_growth: f32) -> DensityConfig {
    DensityConfig { multi_view: MultiViewConfig { max_growth, ..MultiViewConfig::default() }, ..DensityConfig::default() }
}

#[test]
fn those_removed_go_and_those_divided_with_them() {
    let verdicts = [VERDICT_KEEP, VERDICT_SPLIT, VERDICT_REMOVE, VERDICT_KEEP, VERDICT_CLONE].map(|v| word(v, 1.0));
    let plan = plan(&verdicts, 100, &growing(1.0));
    assert_eq!(plan.removed, [1, 2, 4]);
    assert_eq!(plan.divided, [(1, Division::Split), (4, Division::Clone)]);
    assert_eq!((plan.kept(5), plan.len_after(5)), (2, 6));
}

#[test]
fn no_strategy_grows_a_map_beyond_its_room() {
    for strategy in [DensityStrategy::MultiView, DensityStrategy::Classic] {
        let plan = plan(&[word(VERDICT_SPLIT, 1.0); 10], 13, &DensityConfig { strategy, ..growing(1.0) });
        assert_eq!((plan.kept(10), plan.divided.len()), (7, 3));
    }
}

#[test]
fn those_with_most_error_pixels_a_view_are_split_up_to_the_share() {
    let unseen = VERDICT_KEEP;
    let verdicts = [word(VERDICT_SPLIT, 10.0), word(VERDICT_SPLIT, 12.0), unseen, unseen];
    assert_eq!(plan(&verdicts, 100, &growing(0.5)).divided, [(1, Division::Split)]);
    // Equals in map order; without a share none.
    assert_eq!(plan(&[word(VERDICT_SPLIT, 3.0); 4], 100, &growing(0.5)).divided, [(0, Division::Split), (1, Division::Split)]);
    assert!(plan(&verdicts, 100, &growing(1.0).without_growth()).is_empty());
    let classic = DensityConfig { strategy: DensityStrategy::Classic, ..growing(0.0) };
    assert_eq!(plan(&verdicts, 100, &classic).divided.len(), 2, "3DGS divides them all");
}

#[test]
fn of_the_faint_the_half_in_the_way_goes() {
    let faint = [1.0, 5.0, 3.0, 4.0, 2.0].map(|score| word(VERDICT_KEEP, score) | FAINT);
    assert_eq!(plan(&faint, 100, &DensityConfig::default()).removed, [1, 3]);
    // Others' scores do not move the median, and those that go anyway are among the faint.
    let mixed = [faint[0], word(VERDICT_KEEP, 9.0), word(VERDICT_REMOVE, 2.0) | FAINT, faint[2], word(VERDICT_KEEP, 0.0)];
    assert_eq!(plan(&mixed, 100, &DensityConfig::default()).removed, [2, 3]);
}

#[test]
fn the_rules_are_those_of_the_configuration() {
    let multi_view = MultiViewConfig { faint_opacity: 0.5, split_pixels: 1.0, ..MultiViewConfig::default() };
    let config = DensityConfig { strategy: DensityStrategy::Classic, min_opacity: 0.0, multi_view, ..DensityConfig::default() };
    let setup = config.setup(&MapSize { count: 7, capacity: 256, rounds: 3 });
    assert_eq!((setup.count, setup.capacity, setup.round), (7, 256, 3.0));
    assert_eq!((setup.min_age, setup.gradient), (f32::MAX, config.classic.gradient), "one strategy rules");
    assert_eq!((setup.faint_raw_opacity, setup.split_log_pixels), (0.0, 0.0));
    assert!(setup.min_raw_opacity.is_finite(), "an infinity is no uniform");
    let MultiViewConfig { min_weight, min_contribution, error_pixels, pixel_gradient, .. } = config.multi_view;
    assert_eq!([setup.min_weight, setup.min_contribution], [min_weight, min_contribution]);
    assert_eq!([setup.error_pixels, setup.pixel_gradient], [error_pixels, pixel_gradient]);
    assert_eq!(config.without_growth().setup(&MapSize { count: 7, capacity: 256, rounds: 3 }).gradient, f32::MAX);
}

#[test]
fn values_out_of_range_are_refused() {
    let refused = |change: fn(&mut DensityConfig)| {
        let mut config = DensityConfig::default();
        change(&mut config);
        config.validate().is_err()
    };
    assert_eq!(DensityConfig::default().validate(), Ok(()));
    let changes: [fn(&mut DensityConfig); 9] = [
        |c| c.every = 0,
        |c| c.views = 0,
        |c| c.after_share = 1.1,
        |c| c.min_opacity = 1.0,
        |c| c.max_scale_metres = 0.0,
        |c| c.max_scale_metres = f32::INFINITY,
        |c| c.classic.split_pixels = -1.0,
        |c| c.multi_view.error_ratio = f32::NAN,
        |c| c.classic.gradient = -0.1,
    ];
    assert!(changes.into_iter().all(refused));
    assert!(!refused(|c| (c.multi_view.error_pixels, c.classic.gradient) = (0.0, 0.0)), "zero is a threshold");
}
