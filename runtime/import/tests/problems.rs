//! Tests that fields which are missing or contradict each other or the graph are all reported at
//! once, by name, and nothing is imported.

mod common;

use common::{Case, HEAD, SENSOR, mirror, model, node, says, step, value, weight, wide_action};
use lads_import::{Request, template};

#[test]
fn everything_that_is_missing_is_told_at_once() {
    let told = Case::new(&mirror(51), "").refused();
    for field in [
        "environment",
        "control_period_s",
        "action.unit",
        "action.min",
        "action.max",
        "action.scale",
        "action.offset",
        "joints",
        "input `obs`",
    ] {
        assert!(told.contains(field), "{field} is not in\n{told}");
    }
    assert!(told.contains("51 elements"), "{told}");
}

#[test]
fn contradictions_are_told_with_both_sides() {
    let action = wide_action(3);
    for (robot, said) in [
        // Terms that do not add up.
        (
            format!("{HEAD}[[term]]\nname = \"a\"\nwidth = 2\n{SENSOR}{action}"),
            "has 3 elements, its terms add up to 2: a 2",
        ),
        (
            format!(
                "{HEAD}[[term]]\nname = \"a\"\n{SENSOR}[[term]]\nname = \"b\"\n{SENSOR}{action}"
            ),
            "term.a: how many elements",
        ),
        // Names and numbers of another count.
        (
            format!(
                "{HEAD}joints = [\"a\", \"b\", \"c\", \"d\"]\n[[term]]\nname = \"x\"\n{SENSOR}[action]\nunit = \"rad\"\nscale = 1\noffset = 0\nmin = 0\nmax = 1\n"
            ),
            "has 4 names, the output `actions` has 3",
        ),
        (
            format!("{HEAD}[[term]]\nname = \"a\"\nscale = [1, 2]\nwidth = 3\n{SENSOR}{action}"),
            "term.a.scale: has 2 numbers, there are 3",
        ),
        (
            format!(
                "{HEAD}[[term]]\nname = \"a\"\nunit = \"1\"\nmin = [0, 5, 0]\nmax = [1, 5, 1]\n{action}"
            ),
            "element 1 is 5, not below its max 5",
        ),
        (
            format!("{HEAD}[[term]]\nname = \"a\"\nclip = [2, 1]\n{SENSOR}{action}"),
            "is 2 to 1, which is not a range",
        ),
        (
            format!("{HEAD}[[term]]\nname = \"a\"\nscale = nan\n{SENSOR}{action}"),
            "not a finite number",
        ),
        // The default posture of positions is never guessed.
        (
            format!(
                "{HEAD}joints = [\"a\", \"b\", \"c\"]\n[[term]]\nname = \"joint_pos\"\nmin = -1\nmax = 1\n{action}"
            ),
            "term.joint_pos.offset",
        ),
        (
            format!("{HEAD}[[term]]\nname = \"up\"\nfrom = \"gravity\"\n{action}"),
            "quaternion_order",
        ),
        // Histories say how they lie.
        (
            format!("{HEAD}[[term]]\nname = \"a\"\nhistory = 3\n{SENSOR}{action}"),
            "history.layout",
        ),
        (
            format!(
                "{HEAD}robot_joints = [\"b\"]\njoints = [\"a\"]\n[[term]]\nname = \"a\"\n{SENSOR}{action}"
            ),
            "misses \"a\"",
        ),
        (
            format!("{HEAD}[[term]]\nname = \"a\"\nchannel = \"phase\"\n{SENSOR}{action}"),
            "cannot name a channel",
        ),
        (
            format!("{HEAD}[[term]]\nname = \"a b\"\n{SENSOR}{action}"),
            "letters, digits",
        ),
        (
            format!(
                "{HEAD}[[term]]\nname = \"a\"\n{SENSOR}{action}[[state]]\ninput = \"h\"\noutput = \"h\"\n"
            ),
            "\"h\" is not one of them; there are obs",
        ),
        (
            format!("{HEAD}[[term]]\nname = \"last_action\"\n{action}"),
            "no term comes from the caller",
        ),
        (
            "control_period = 1".into(),
            "unknown field `control_period`",
        ),
    ] {
        let told = Case::new(&mirror(3), &robot).refused();
        assert!(told.contains(said), "{robot}\n{told}");
    }
}

/// What a convolution finds too short is a length that nobody said: the axis is told, not the convolution. What is wrong at any length is told
/// all the same.
#[test]
fn axes_of_unknown_length_are_told_and_nothing_that_follows_from_them() {
    use lads_compiler::onnx::DimensionProto;
    let named = |name: &str| DimensionProto {
        dim_value: None,
        dim_param: Some(name.into()),
    };
    let mut image = value("image", &[-1, 3, 1, 1]);
    let shape = image.r#type.as_mut().and_then(|ty| ty.tensor_type.as_mut());
    let shape = shape.and_then(|tensor| tensor.shape.as_mut()).unwrap();
    shape.dim[2] = named("height");
    shape.dim[3] = named("width");
    let weights = weight("w", &[4, 3, 3, 3], &[0.1; 108]);
    let policy = |odd: &str| {
        model(
            vec![image.clone()],
            vec![
                node("Conv", &["image", "w"], &["c"]),
                node(odd, &["c"], &["r"]),
                node("GlobalAveragePool", &["r"], &["p"]),
                node("Flatten", &["p"], &["actions"]),
            ],
            vec![weights.clone()],
            vec![value("actions", &[1, 4])],
        )
    };
    let term = format!("[[term]]\nname = \"camera\"\ninput = \"image\"\n{SENSOR}");
    let robot = format!("{HEAD}{term}{}", wide_action(4));
    let told = Case::new(&policy("Relu"), &robot).refused();
    assert!(
        told.contains("an axis `height` of unknown length"),
        "{told}"
    );
    assert!(told.contains("axes.height = LENGTH"), "{told}");
    assert!(told.contains("axes.width = LENGTH"), "{told}");
    assert!(
        told.contains("settle its shape first") && !told.contains("none of them"),
        "{told}"
    );
    assert!(!told.contains("window") && !told.contains("Conv"), "{told}");
    let told = Case::new(&policy("Hardmax"), &robot).refused();
    assert!(
        told.contains("Hardmax") && !told.contains("window"),
        "{told}"
    );
    // A length that was said is judged.
    let robot = format!("axes = {{ height = 2, width = 8 }}\n{robot}");
    let told = Case::new(&policy("Relu"), &robot).refused();
    assert!(told.contains("a window of 3 over 2 elements"), "{told}");
}

#[test]
fn the_form_names_all_and_is_enough_once_it_is_filled_in() {
    let mut policy = mirror(6);
    says(
        &mut policy,
        &[
            ("joint_names", "hip,knee,toe,heel,tail,neck"),
            ("default_joint_pos", "0.1,0.2,0.3,0.4,0.5,0.6"),
            ("observation_names", "joint_pos"),
            ("action_scale", "0.25"),
            ("run_path", "/home/somebody/runs/1"),
        ],
    );
    let case = Case::new(&policy, "");
    let path = case.path("policy.onnx");
    let request = Request {
        models: vec![&path],
        ..Request::default()
    };
    let form = template(&request).expect("a form");
    assert!(!form.contains("somebody"), "{form}");
    // A person takes the `#` away from the fields that are missing.
    let wanted = [
        "environment",
        "control_period_s",
        "min",
        "max",
        "offset",
        "unit",
    ];
    let filled: Vec<String> = form
        .lines()
        .map(|line| match line.strip_prefix("# ") {
            Some(field)
                if wanted
                    .iter()
                    .any(|name| field.starts_with(&format!("{name} = "))) =>
            {
                field.to_owned()
            }
            _ => line.to_owned(),
        })
        .collect();
    case.put("robot.toml", filled.join("\n").as_bytes());
    let imported = case
        .import()
        .unwrap_or_else(|error| panic!("{error}\n{form}"));
    assert!(
        imported
            .notes
            .iter()
            .any(|note| note.contains("joint_names"))
    );
    let text = String::from_utf8_lossy(&imported.bundle).into_owned();
    assert!(
        !text.contains("somebody") && !text.contains("run_path"),
        "private data in the bundle"
    );
    assert!(!text.contains(&*case.folder.path().to_string_lossy()));
}

#[test]
fn no_name_or_number_of_a_file_breaks_the_form() {
    // A line break in a name would end its comment, and the rest of the name would be a field.
    let name = "obs\nscale = 7\u{7f}";
    let mut policy = model(
        vec![value(name, &[1, 2])],
        vec![node("Identity", &[name], &["actions"])],
        vec![],
        vec![value("actions", &[1, 2])],
    );
    says(
        &mut policy,
        &[
            ("joint_names", "hip\u{7f},\u{1}knee"),
            ("default_joint_pos", "nan,inf"),
            ("action_scale", "NaN"),
            ("observation_names", "joint_pos,a\nb\u{7f}"),
        ],
    );
    let case = Case::new(&policy, "");
    case.put("deploy.yaml", b"step_dt: .nan");
    let form = template(&Request {
        models: vec![&case.path("policy.onnx")],
        ..Request::default()
    })
    .expect("a form");
    let read: toml::Table = toml::from_str(&form).unwrap_or_else(|error| panic!("{error}\n{form}"));
    assert!(!read.contains_key("scale"), "{form}");
    assert_eq!(read["joints"][0].as_str(), Some("hip\u{7f}"));
}

#[test]
fn neighbours_are_read_and_have_to_agree() {
    let deploy = "step_dt: 0.02\njoint_ids_map: [1, 0]\ndefault_joint_pos: [0.5, 0.6]\nstiffness: [10, 20]\ndamping: [1, 2]\n\
        actions: {JointPositionAction: {scale: [0.25, 0.5], offset: [0.5, 0.6], clip: null}}\n\
        observations:\n  joint_pos_rel: {scale: [1.0, 1.0], clip: null, history_length: 1}\n";
    let robot = "environment = { id = \"biped\", version = \"1\" }\nrobot_joints = [\"left\", \"right\"]\n\
        [[term]]\nname = \"joint_pos_rel\"\nmin = -3\nmax = 3\n[action]\nmin = -3\nmax = 3\n";
    let case = Case::new(&mirror(2), robot);
    case.put("params/deploy.yaml", deploy.as_bytes());
    let actions = case.actions(&[step(&[&[0.6, 0.5]]), step(&[&[1.6, 2.5]])]);
    // Left and right are 0.6 and 0.5 at rest, and go back where they are.
    common::close(&actions[0], &[0.6, 0.5]);
    common::close(&actions[1], &[1.1, 1.0]);
    let bundle =
        lads_compiler::Bundle::from_bytes(&case.import().expect("again").bundle).expect("a bundle");
    let gains: Vec<_> = (bundle.contract().action().elements.iter())
        .map(|element| (element.name.clone(), element.stiffness))
        .collect();
    assert_eq!(
        gains,
        [("left".into(), Some(10.0)), ("right".into(), Some(20.0))]
    );

    let other = Case::new(&mirror(2), &robot.replace("joint_pos_rel", "dof_pos"));
    other.put("deploy.yaml", deploy.as_bytes());
    assert!(
        other
            .refused()
            .contains("dof_pos here and joint_pos_rel there")
    );
    // The form says so too, instead of leaving a file out without a word.
    let form = template(&Request {
        models: vec![&other.path("policy.onnx")],
        beside: vec![&other.path("policy.onnx")],
        ..Request::default()
    });
    assert!(form.expect("a form").contains("Problems of the files"));
    // Left out, it contradicts nothing; named, it is read all the same.
    let alone = |beside| {
        other
            .import_with(|request| (request.alone, request.beside) = (true, beside))
            .expect_err("more is needed")
            .to_string()
    };
    let named = other.path("deploy.yaml");
    assert!(!alone(vec![]).contains("joint_pos_rel"));
    assert!(alone(vec![&named]).contains("dof_pos here and joint_pos_rel there"));
    let bomb = Case::new(&mirror(2), robot);
    bomb.put("deploy.yaml", "[".repeat(10_000).as_bytes());
    let told = bomb.refused();
    assert!(told.contains("deploy.yaml: is "), "{told}");
}

#[test]
fn rounded_gains_are_told_until_somebody_says_them() {
    let mut policy = mirror(2);
    says(
        &mut policy,
        &[
            ("joint_names", "hip,knee"),
            ("joint_stiffness", "0.000,0.000"),
            ("joint_damping", "1.000,1.000"),
        ],
    );
    let robot = format!(
        "{HEAD}[[term]]\nname = \"a\"\n{SENSOR}[action]\nunit = \"rad\"\nscale = 1\noffset = 0\nmin = -1\nmax = 1\n"
    );
    let told = Case::new(&policy, &robot).refused();
    assert!(
        told.contains("action.stiffness") && told.contains("action.damping"),
        "{told}"
    );
    let case = Case::new(
        &policy,
        &format!("{robot}stiffness = 0.0004\ndamping = 0.02\n"),
    );
    case.import().unwrap_or_else(|error| panic!("{error}"));
    // Four names and three actions, as in a public file.
    let mut policy = mirror(3);
    says(&mut policy, &[("joint_names", "a,b,c,d")]);
    let told = Case::new(&policy, &robot).refused();
    assert!(
        told.contains("has 4 names") && told.contains("3 elements"),
        "{told}"
    );
}

#[test]
fn a_recorded_run_has_to_be_what_the_graph_does() {
    let robot = format!(
        "{HEAD}[[term]]\nname = \"a\"\nwidth = 2\n{SENSOR}{}tolerance = 0.01\n",
        wide_action(2)
    );
    let case = Case::new(&mirror(2), &robot);
    let csv = case.path("run.csv");
    let import = |text: &str| {
        case.put("run.csv", text.as_bytes());
        case.import_with(|request| request.golden = Some(&csv))
            .map_err(|error| error.to_string())
    };
    let head = "observation.a.0, observation.a.1, action.a0, action.a1, reset\n";
    let good = format!("{head}1,2,1,2,0\n3,4,3,4,0\n5,6,5.001,6,1\n");
    let bundle = import(&good)
        .unwrap_or_else(|error| panic!("{error}"))
        .bundle;
    let bundle = lads_compiler::Bundle::from_bytes(&bundle).expect("a bundle");
    assert_eq!(bundle.golden().steps(), 2, "the first episode");
    let error = import(&good.replace("3,4,3,4", "3,4,3,4.5")).expect_err("another action");
    assert!(
        error.contains("`a1`") && error.contains("4.5 in step 1"),
        "{error}"
    );
    let error = import("observation.a.0,action.a0\n1,1\n").expect_err("columns are missing");
    assert!(
        error.contains("observation.a.1") && error.contains("action.a1"),
        "{error}"
    );
    assert!(import(head).expect_err("no rows").contains("has no rows"));
    assert!(
        import(&format!("{head}1,x,1,2,0\n"))
            .expect_err("no number")
            .contains("`x`")
    );
}
