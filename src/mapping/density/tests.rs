use super::*;
use glam::Quat;

/// A disc of 10 cm by 2 cm a metre away, well seen and well placed.
fn good() -> Candidate {
    Candidate {
        geometry: GaussianGeometry {
            mean: Vec3::new(0.0, 0.0, 1.0),
            raw_opacity: raw_opacity_from_opacity(0.6),
            log_scale: Vec3::new(0.02, 0.1, 0.01).map(f32::ln),
            rotation: Quat::from_rotation_z(std::f32::consts::FRAC_PI_2),
        },
        score: GaussianScore {
            weight_sum: 80.0,
            weight_max: 0.5,
            views: 4.0,
            metres_per_pixel: 0.005,
            ..GaussianScore::default()
        },
        history: GaussianHistory { age: 5, views: 12, best_weight: 0.5, contribution: 20.0, anchor: 0 },
    }
}

fn shaped(mut candidate: Candidate, change: impl Fn(&mut GaussianGeometry)) -> Candidate {
    change(&mut candidate.geometry);
    candidate
}

fn coarse() -> Candidate {
    let score =
        GaussianScore { error_pixels: 80.0, weighted_error_pixels: 8.0, absolute_gradient: 0.1, gradient: 0.05, ..good().score };
    Candidate { score, ..good() }
}

#[test]
fn vcd_divides_what_several_views_call_too_coarse_and_nothing_else() {
    let config = DensityConfig {
        multi_view: MultiViewConfig { max_growth: 1.0, ..MultiViewConfig::default() },
        ..DensityConfig::default()
    };
    let fine = shaped(coarse(), |g| g.log_scale = Vec3::splat(0.001f32.ln()));
    let young = Candidate { history: GaussianHistory { age: 0, ..good().history }, ..coarse() };
    let unseen = Candidate { score: GaussianScore::default(), ..coarse() };
    let plan = plan(&[good(), coarse(), fine, young, unseen], 100, &config);
    assert_eq!(plan.keep, [0, 2, 3, 4]);
    let [a, b] = &plan.children[..] else { panic!("{:?}", plan.children) };
    assert_eq!((a.parent, b.parent), (1, 1));
    // Along the long axis, which the rotation lays along -x.
    assert!((a.mean - b.mean).length() > 0.1 && (a.mean - b.mean).y.abs() < 1e-6);
    assert!((a.mean + b.mean - 2.0 * coarse().geometry.mean).length() < 1e-6 && a.log_scale.y < coarse().geometry.log_scale.y);
}

#[test]
fn what_is_never_seen_and_what_went_bad_goes() {
    let config = DensityConfig::default();
    let hidden = Candidate { history: GaussianHistory { best_weight: 0.001, ..good().history }, ..good() };
    let speck = Candidate { history: GaussianHistory { contribution: 0.5, ..good().history }, ..good() };
    let new = Candidate { history: GaussianHistory::default(), ..hidden };
    let nan = shaped(good(), |g| g.mean = Vec3::NAN);
    let faint = shaped(good(), |g| g.raw_opacity = raw_opacity_from_opacity(0.01));
    let huge = shaped(good(), |g| g.log_scale = Vec3::splat(4.0));
    let all = [good(), hidden, new, nan, faint, huge, speck];
    assert_eq!(plan(&all, 100, &config).keep, [0, 2]);
    // Without control of density only what went bad goes.
    let none = DensityConfig { strategy: DensityStrategy::None, ..config };
    assert_eq!(plan(&all, 100, &none).keep, [0, 1, 2, 6]);
}

#[test]
fn no_strategy_grows_a_map_beyond_its_room() {
    for strategy in [DensityStrategy::MultiView, DensityStrategy::Classic] {
        let multi_view = MultiViewConfig { max_growth: 1.0, ..MultiViewConfig::default() };
        let config = DensityConfig { strategy, multi_view, ..DensityConfig::default() };
        let plan = plan(&[coarse(); 10], 13, &config);
        assert_eq!((plan.keep.len(), plan.children.len()), (7, 6));
    }
}

/// With a history that no strategy prunes.
fn scored(score: GaussianScore) -> Candidate {
    Candidate { score: GaussianScore { metres_per_pixel: 0.005, ..score }, ..good() }
}

#[test]
fn classic_control_follows_the_mean_gradient_and_the_size() {
    let config = ClassicConfig { gradient: 0.25, split_pixels: 16.0 };
    let with = |views: f32, gradient: f32| scored(GaussianScore { views, gradient, ..GaussianScore::default() });
    let unseen = with(0.0, 1.0);
    // Means of 0.15 (a sum above the threshold), 0.25 and 0.5; the disc of 10 cm is 20 pixels wide.
    let decisions = classic::decide(&[unseen, with(2.0, 0.3), with(2.0, 0.5), with(2.0, 1.0)], &config);
    assert_eq!(decisions, [Decision::Keep, Decision::Keep, Decision::Split, Decision::Split]);
    let pixels = with(2.0, 1.0).pixels();
    let at = |split_pixels: f32| classic::decide(&[with(2.0, 1.0)], &ClassicConfig { split_pixels, ..config.clone() })[0];
    assert_eq!((at(pixels * 0.99), at(pixels), at(pixels * 1.01)), (Decision::Split, Decision::Clone, Decision::Clone));
}

#[test]
fn those_with_most_error_pixels_a_view_are_split_up_to_the_share() {
    let config = MultiViewConfig { max_growth: 0.5, ..MultiViewConfig::default() };
    let with = |views: f32, error_pixels: f32| {
        scored(GaussianScore { views, error_pixels, absolute_gradient: 1.0, ..GaussianScore::default() })
    };
    // 10 and 12 error pixels a view; the unseen ones count for no share.
    let decisions = multi_view::decide(&[with(6.0, 60.0), with(3.0, 36.0), with(0.0, 0.0), with(0.0, 0.0)], &config);
    assert_eq!(decisions, [Decision::Keep, Decision::Split, Decision::Keep, Decision::Keep]);
}

#[test]
fn the_worse_half_of_the_faint_is_pruned() {
    let config = MultiViewConfig { max_growth: 0.0, ..MultiViewConfig::default() };
    let with = |opacity: f32, views: f32, age: u32, weighted_error_pixels: f32| {
        let mut candidate = scored(GaussianScore { views, weighted_error_pixels, ..GaussianScore::default() });
        candidate.geometry.raw_opacity = raw_opacity_from_opacity(opacity);
        candidate.history.age = age;
        candidate
    };
    let old = config.min_age;
    let faint = [with(0.05, 1.0, old, 1.0), with(0.05, 2.0, old, 2.0), with(0.05, 4.0, old, 3.0)];
    // Opaque, unseen and young ones are neither pruned nor part of the median, which their scores would move both ways.
    let others = [
        with(0.5, 1.0, old, 9.0),
        with(0.5, 1.0, old, 0.0),
        with(0.05, 0.0, old, 9.0),
        with(0.05, 0.0, old, 0.0),
        with(0.05, 1.0, old - 1, 9.0),
        with(0.05, 1.0, old - 1, 0.0),
    ];
    let decisions = multi_view::decide(&[&faint[..], &others].concat(), &config);
    let removed: Vec<usize> = (0..decisions.len()).filter(|i| decisions[*i] == Decision::Remove).collect();
    assert_eq!(removed, [2]);
    // High scores alone do not move the median either.
    let high: Vec<Candidate> = others.into_iter().step_by(2).collect();
    let decisions = multi_view::decide(&[&faint[..], &high].concat(), &config);
    assert_eq!(decisions.iter().filter(|v| **v == Decision::Remove).count(), 1);
}

#[test]
fn two_in_place_of_one_lie_along_its_longest_axis() {
    let parent = good();
    // The rotation lays the longest axis, 10 cm, along -x.
    for (clone, metres, opacity, longest) in [(false, 0.06, 0.85 * 0.6, 0.07f32), (true, 0.025, 1.0 - 0.4f32.sqrt(), 0.1)] {
        let [a, b] = divide(3, &parent, clone);
        assert_eq!((a.parent, b.parent), (3, 3));
        assert!((a.mean - Vec3::new(metres, 0.0, 1.0)).length() < 1e-6, "{a:?}");
        assert!((b.mean - Vec3::new(-metres, 0.0, 1.0)).length() < 1e-6, "{b:?}");
        for child in [a, b] {
            assert!((opacity_from_raw(child.raw_opacity) - opacity).abs() < 1e-6, "{child:?}");
            assert!((child.log_scale.exp() - Vec3::new(0.02, longest, 0.01)).length() < 1e-6, "{child:?}");
        }
    }
}

#[test]
fn thresholds_of_splitting_are_means_over_views_and_exclusive() {
    let splits = |candidate: Candidate, config: &MultiViewConfig| {
        let multi_view = MultiViewConfig { max_growth: 1.0, ..config.clone() };
        let config = DensityConfig { multi_view, ..DensityConfig::default() };
        !plan(&[candidate], 100, &config).children.is_empty()
    };
    let config = MultiViewConfig::default();
    let with = |error_pixels: f32, absolute_gradient: f32| {
        let score = GaussianScore { error_pixels, absolute_gradient, ..coarse().score };
        Candidate { score, ..coarse() }
    };
    let (pixels, gradient) = (4.0 * config.error_pixels, 4.0 * config.absolute_gradient);
    assert!(splits(with(1.01 * pixels, 1.01 * gradient), &config));
    assert!(!splits(with(pixels, 1.01 * gradient), &config));
    assert!(!splits(with(1.01 * pixels, gradient), &config));
    let size = MultiViewConfig { split_pixels: coarse().pixels(), ..config };
    assert!(!splits(coarse(), &size));
    assert!(splits(coarse(), &MultiViewConfig { split_pixels: 0.99 * size.split_pixels, ..size }));
}

#[test]
fn thresholds_of_pruning_are_exclusive() {
    let config = DensityConfig::default();
    let MultiViewConfig { min_weight, min_contribution, .. } = config.multi_view;
    let at = |best_weight: f32, contribution: f32| Candidate {
        history: GaussianHistory { best_weight, contribution, ..good().history },
        ..good()
    };
    let all = [at(min_weight, 9.0), at(0.99 * min_weight, 9.0), at(0.5, min_contribution), at(0.5, 0.99 * min_contribution)];
    assert_eq!(plan(&all, 100, &config).keep, [0, 2]);
}

#[test]
fn of_the_faint_the_half_in_the_way_goes() {
    let faint = |weighted_error_pixels: f32| {
        let score = GaussianScore { weighted_error_pixels, ..good().score };
        shaped(Candidate { score, ..good() }, |g| g.raw_opacity = raw_opacity_from_opacity(0.08))
    };
    let all = [1.0, 5.0, 3.0, 4.0, 2.0].map(faint);
    assert_eq!(plan(&all, 100, &DensityConfig::default()).keep, [0, 2, 4]);
    // An opacity at the threshold is not faint.
    let multi_view = MultiViewConfig { faint_opacity: all[0].opacity(), ..MultiViewConfig::default() };
    assert_eq!(plan(&all, 100, &DensityConfig { multi_view, ..DensityConfig::default() }).keep, [0, 1, 2, 3, 4]);
}

#[test]
fn without_growth_nothing_is_divided() {
    for strategy in [DensityStrategy::MultiView, DensityStrategy::Classic] {
        let multi_view = MultiViewConfig { max_growth: 1.0, ..MultiViewConfig::default() };
        let config = DensityConfig { strategy, multi_view, ..DensityConfig::default() };
        assert!(!plan(&[coarse()], 100, &config).children.is_empty());
        assert!(plan(&[coarse()], 100, &config.without_growth()).children.is_empty());
        assert_eq!(config.without_growth().strategy, strategy);
    }
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
