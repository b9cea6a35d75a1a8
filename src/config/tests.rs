use super::*;

#[test]
fn the_resolved_configuration_reads_back_the_same() {
    let mut config = Config { adapter: Some("llvmpipe".into()), ..Config::default() };
    config.sequence =
        Some(SequenceConfig { path: "kitchen".into(), layout: Some(Layout::named("tum")), sensor: None, camera: None });
    config.replay.frames = Some((3, 9));
    assert_eq!(toml::from_str::<Config>(&config.to_toml()).unwrap(), config);
}

#[test]
fn unknown_keys_and_wrong_values_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.toml");
    std::fs::write(&path, "map_scale = 0.5\n[mapping.loss]\nssim_wieght = 0.1\n").unwrap();
    let message = Config::read(&path).unwrap_err().to_string();
    assert!(message.contains("run.toml") && message.contains("line 3") && message.contains("ssim_wieght"), "{message}");
    let wrong = |text: &str| toml::from_str::<Config>(text).unwrap().validate().unwrap_err().to_string();
    assert!(wrong("map_scale = 2.0").contains("map_scale"));
    assert!(wrong("[mapping.insertion]\nstride = 0").contains("stride"));
    assert!(wrong("[mapping.adam]\nbeta_1 = 1.0").contains("beta_1"));
}

#[test]
fn keys_of_earlier_versions_are_refused_by_their_new_names() {
    for (old, new) in RENAMED {
        let setting = format!("{old}=1");
        let (section, key) = old.rsplit_once('.').unwrap();
        let in_file = Config::parse(&format!("[{section}]\n{key} = 1\n"), Path::new("run.toml"), false).unwrap_err();
        let said = Config::default().with_settings(&[setting]).unwrap_err().to_string();
        for message in [in_file.to_string(), said] {
            assert!(message.contains(old) && message.contains(new), "{message}");
        }
        let mut table = toml::Table::try_from(Config::default()).unwrap();
        for part in new.split('.') {
            let next = table.get(part).unwrap_or_else(|| panic!("there is no {new}")).clone();
            table = next.as_table().cloned().unwrap_or_default();
        }
    }
}

#[test]
fn a_file_goes_over_the_defaults_for_known_poses() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.toml");
    std::fs::write(&path, "[mapping.refine]\ndensity_every = 70\n").unwrap();
    let offline = Config::read_with(&path, true).unwrap();
    assert_eq!((offline.mapping.refine.density_every, offline.replay.known_poses), (70, true));
    assert_eq!(offline.mapping.refine.steps, MappingConfig::offline().refine.steps);
    assert_eq!(Config::read(&path).unwrap().mapping.refine.steps, 0);
    std::fs::write(&path, offline.to_toml()).unwrap();
    assert_eq!(Config::read(&path).unwrap(), offline);
}

#[test]
fn single_values_are_set_by_their_keys() {
    let config =
        Config::default().with_settings(&["mapping.seed=7", "adapter=llvmpipe", "mapping.loss.ssim_weight=0.3"]).unwrap();
    assert_eq!((config.mapping.seed, config.adapter.as_deref(), config.mapping.loss.ssim_weight), (7, Some("llvmpipe"), 0.3));
    let wrong = |text: &str| Config::default().with_settings(&[text]).unwrap_err().to_string();
    assert!(wrong("mapping.seeed=7").contains("seeed") && wrong("maping.seed=7").contains("no such"));
    assert!(wrong("map_scale=2.0").contains("map_scale") && wrong("mapping.seed").contains("key=value"));
}

#[test]
fn the_first_frame_is_never_held_out() {
    let replay = ReplayConfig::default();
    let held: Vec<usize> = (0..24).filter(|i| replay.is_held_out(*i)).collect();
    assert_eq!(held, [7, 15, 23]);
    assert!(!(0..24).any(|i| ReplayConfig { held_out_every: 0, ..ReplayConfig::default() }.is_held_out(i)));
}

/// Dotted keys of all numbers in a table, with their defaults.
fn numbers(table: &toml::Table, prefix: &str) -> Vec<(String, toml::Value)> {
    let of = |(key, value): (&String, &toml::Value)| {
        let key = format!("{prefix}{key}");
        match value {
            toml::Value::Table(inner) => numbers(inner, &format!("{key}.")),
            toml::Value::Float(_) | toml::Value::Integer(_) => vec![(key, value.clone())],
            _ => Vec::new(),
        }
    };
    table.iter().flat_map(of).collect()
}

#[test]
fn every_number_has_a_range() {
    let table = toml::Table::try_from(Config::default()).unwrap();
    let mut open = Vec::new();
    let numbers = numbers(&table, "");
    assert!(numbers.len() > 80, "{}", numbers.len());
    for (key, value) in numbers {
        let impossible: &[&str] = if value.is_float() { &["nan", "-1e30"] } else { &["-1"] };
        let refused = |wrong: &str| Config::default().with_settings(&[format!("{key}={wrong}")]).is_err();
        open.extend(impossible.iter().filter(|wrong| !refused(wrong)).map(|wrong| format!("{key}={wrong}")));
    }
    assert!(open.is_empty(), "these values are accepted: {open:?}");
}
