//! Whole recordings at a small size.
use super::*;

/// Prints how long the demo takes; run by hand.
#[test]
#[ignore]
fn demo_time() {
    let config = SceneConfig::read(Path::new(&std::env::var("SCENE").unwrap())).unwrap();
    let out = PathBuf::from(std::env::var("OUT").unwrap());
    let start = std::time::Instant::now();
    let frames: Vec<usize> =
        std::env::var("FRAMES").map(|f| f.split(',').map(|n| n.parse().unwrap()).collect()).unwrap_or_default();
    if frames.is_empty() {
        generate(&config, &out, &|_, _| ()).unwrap();
    } else {
        let recording = Recording::new(&config).unwrap();
        println!("built after {:?}, {} solids", start.elapsed(), recording.renderer.solids());
        let sensor = degrade::Sensor::new(&config);
        let writer = write::Writer::new(&out).unwrap();
        frames.par_iter().for_each(|f| writer.frame(&config, *f, &sensor.record(&recording.render(*f), *f)).unwrap());
        println!("{} frames after {:?}", frames.len(), start.elapsed());
        writer.finish(&config, &recording.trajectory()).unwrap();
    }
    println!("{:?}", start.elapsed());
}
