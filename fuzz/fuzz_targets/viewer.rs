//! Messages of viewers. A camera that is accepted is finite, and its picture is bounded.
#![no_main]

use keysplat::viewing::FromViewer;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Some(FromViewer::Render(request)) = FromViewer::parse(text)
        && let Some((pinhole, pose)) = request.camera()
    {
        assert!(pinhole.width <= 1920 && pinhole.height <= 1920 && pinhole.fx.is_finite() && pinhole.fy.is_finite());
        assert!(pose.to_homogeneous().iter().all(|value| value.is_finite()));
    }
});
