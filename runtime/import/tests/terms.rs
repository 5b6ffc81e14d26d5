//! Tests the nodes that an import puts between raw sensor values and a graph, through policies that
//! only mirror their input.

mod common;

use common::{
    Case, HEAD, Happens::Reset, SENSOR, close, mirror, model, node, step, value, weight,
    wide_action,
};

#[test]
fn a_term_is_moved_clipped_and_scaled_in_this_order() {
    let robot = format!(
        "{HEAD}[[term]]\nname = \"a\"\nwidth = 2\n{SENSOR}offset = [1, 2]\nclip = [-1, [2, 3]]\nscale = 10\n\
         [[term]]\nname = \"b\"\n{SENSOR}\n[input.obs]\nclip = 25\n{}",
        wide_action(3)
    );
    let case = Case::new(&mirror(3), &robot);
    let actions = case.actions(&[step(&[&[2.0, 2.0, 7.0]]), step(&[&[50.0, -50.0, 40.0]])]);
    close(&actions[0], &[10.0, 0.0, 7.0]);
    close(&actions[1], &[20.0, -10.0, 25.0]);
}

#[test]
fn joints_come_and_go_in_the_robots_order() {
    let robot = format!(
        "{HEAD}joints = [\"hip\", \"knee\", \"toe\"]\nrobot_joints = [\"toe\", \"neck\", \"hip\", \"knee\"]\n\
         [[term]]\nname = \"joint_pos\"\nmin = [-1, -2, -3]\nmax = 9\noffset = [0.1, 0.2, 0.3]\n\
         [action]\nunit = \"rad\"\nscale = [1, 10, 100]\noffset = 0\nmin = -999\nmax = 999\n"
    );
    let case = Case::new(&mirror(3), &robot);
    // The robot gives toe, hip, knee.
    let actions = case.actions(&[step(&[&[3.3, 1.1, 2.2]])]);
    close(&actions[0], &[300.0, 1.0, 20.0]);
    let contract = lads_compiler::Bundle::from_bytes(&case.import().expect("again").bundle)
        .expect("a bundle")
        .contract()
        .clone();
    let row = |channel: &lads_compiler::contract::Channel| -> Vec<(Option<String>, f32)> {
        let elements = channel.elements.iter();
        elements
            .map(|element| (element.joint.clone(), element.min))
            .collect()
    };
    let joint = |name: &str| Some(name.to_owned());
    assert_eq!(
        row(contract.observation()),
        [
            (joint("toe"), -3.0),
            (joint("hip"), -1.0),
            (joint("knee"), -2.0)
        ]
    );
    assert_eq!(row(contract.action())[0].0, joint("toe"));
}

/// Returns histories of two terms, `a` of one element and `b` of two, over three steps.
fn history(layout: &str, order: &str, start: &str) -> Vec<Vec<f32>> {
    let robot = format!(
        "{HEAD}history = {{ length = 3, layout = \"{layout}\", order = \"{order}\", start = \"{start}\" }}\n\
         [[term]]\nname = \"a\"\nwidth = 1\n{SENSOR}scale = 2\n[[term]]\nname = \"b\"\nwidth = 2\n{SENSOR}offset = 1\n{}",
        wide_action(9)
    );
    let case = Case::new(&mirror(9), &robot);
    let rows = [
        [1.0, 11.0, 21.0],
        [2.0, 12.0, 22.0],
        [3.0, 13.0, 23.0],
        [4.0, 14.0, 24.0],
    ];
    let mut steps: Vec<_> = rows.iter().map(|row| step(&[&row[..]])).collect();
    steps.insert(3, Reset);
    case.actions(&steps)
}

#[test]
fn histories_are_laid_out_as_the_graph_reads_them() {
    let by_term = history("term", "oldest_first", "first");
    close(
        &by_term[0],
        &[2.0, 2.0, 2.0, 10.0, 20.0, 10.0, 20.0, 10.0, 20.0],
    );
    close(
        &by_term[2],
        &[2.0, 4.0, 6.0, 10.0, 20.0, 11.0, 21.0, 12.0, 22.0],
    );
    // Another episode knows nothing of the one before.
    close(
        &by_term[3],
        &[8.0, 8.0, 8.0, 13.0, 23.0, 13.0, 23.0, 13.0, 23.0],
    );
    let by_time = history("time", "newest_first", "zero");
    close(
        &by_time[0],
        &[2.0, 10.0, 20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    );
    close(
        &by_time[2],
        &[6.0, 12.0, 22.0, 4.0, 11.0, 21.0, 2.0, 10.0, 20.0],
    );
    close(
        &by_time[3],
        &[8.0, 13.0, 23.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    );
    let by_element = history("element", "oldest_first", "zero");
    close(
        &by_element[1],
        &[0.0, 2.0, 4.0, 0.0, 10.0, 11.0, 0.0, 20.0, 21.0],
    );
}

#[test]
fn terms_may_have_histories_of_their_own() {
    let robot = format!(
        "{HEAD}history = {{ layout = \"term\", order = \"oldest_first\", start = \"first\" }}\n\
         [[term]]\nname = \"a\"\nwidth = 1\n{SENSOR}history = 3\n[[term]]\nname = \"b\"\nwidth = 1\n{SENSOR}history = 2\n[[term]]\nname = \"c\"\n{SENSOR}{}",
        wide_action(6)
    );
    let case = Case::new(&mirror(6), &robot);
    let actions = case.actions(&[step(&[&[1.0, 2.0, 3.0]]), step(&[&[4.0, 5.0, 6.0]])]);
    close(&actions[1], &[1.0, 1.0, 4.0, 2.0, 5.0, 6.0]);
}

#[test]
fn the_runtime_feeds_the_last_raw_action_itself() {
    // action = clip(2 * a + last, +-8), and the robot gets that over ten plus one.
    let graph = model(
        vec![value("obs", &[-1, 2])],
        vec![node("MatMul", &["obs", "w"], &["actions"])],
        vec![weight("w", &[2, 1], &[2.0, 1.0])],
        vec![value("actions", &[-1, 1])],
    );
    let robot = format!(
        "{HEAD}[[term]]\nname = \"a\"\n{SENSOR}[[term]]\nname = \"last_action\"\n\
         [action]\nelements = [\"x\"]\nunit = \"m\"\nclip = 8\nscale = 0.1\noffset = 1\nmin = -0.5\nmax = 1.6\n"
    );
    let case = Case::new(&graph, &robot);
    let one = || step(&[&[1.0]]);
    let actions = case.actions(&[one(), one(), one(), step(&[&[4.0]]), one(), Reset, one()]);
    let flat: Vec<f32> = actions.concat();
    // Raw 2, 4, 6, then 8 of 14, then 8 of 10; limits bound what the robot gets, not what is fed back.
    close(&flat, &[1.2, 1.4, 1.6, 1.6, 1.6, 1.2]);
}

#[test]
fn gravity_follows_from_an_orientation_in_either_order() {
    let (sin, cos) = (0.5_f32.sqrt(), 0.5_f32.sqrt());
    // Upright, then turned by 90 degrees about x: what points down is then the body's -y; and not of unit length.
    for (order, upright, turned) in [
        ("wxyz", [1.0, 0.0, 0.0, 0.0], [cos, sin, 0.0, 0.0]),
        ("xyzw", [0.0, 0.0, 0.0, 0.5], [sin, 0.0, 0.0, cos]),
    ] {
        let robot = format!(
            "{HEAD}quaternion_order = \"{order}\"\n[[term]]\nname = \"up\"\nfrom = \"gravity\"\nchannel = \"imu\"\n{}",
            wide_action(3)
        );
        let case = Case::new(&mirror(3), &robot);
        let actions = case.actions(&[step(&[&upright[..]]), step(&[&turned[..]])]);
        close(&actions[0], &[0.0, 0.0, -1.0]);
        close(&actions[1], &[0.0, -1.0, 0.0]);
    }
}

#[test]
fn the_clock_the_step_and_the_first_step_are_the_runtimes() {
    let robot = format!(
        "{HEAD}[[term]]\nname = \"clock\"\nfrom = \"phase\"\nphase = {{ period_s = 0.08, elements = [{{ of = \"sin\" }}, {{ of = \"cos\", ahead = 0.25 }}] }}\n\
         [[term]]\nname = \"count\"\nfrom = \"step\"\n[[term]]\nname = \"begins\"\nfrom = \"first\"\n[[term]]\nname = \"a\"\n{SENSOR}{}",
        wide_action(5)
    );
    let case = Case::new(&mirror(5), &robot);
    let one = || step(&[&[7.0]]);
    let mut steps: Vec<_> = (0..400).map(|_| one()).collect();
    steps.extend([Reset, one()]);
    let actions = case.actions(&steps);
    close(&actions[0], &[0.0, 0.0, 0.0, 1.0, 7.0]);
    close(&actions[1], &[1.0, -1.0, 1.0, 0.0, 7.0]);
    close(&actions[2], &[0.0, 0.0, 2.0, 0.0, 7.0]);
    // A hundred periods later the clock has not drifted.
    close(&actions[397], &[1.0, -1.0, 397.0, 0.0, 7.0]);
    close(&actions[400], &[0.0, 0.0, 0.0, 1.0, 7.0]);
}

#[test]
fn states_of_the_graph_are_kept_and_cleared() {
    let graph = model(
        vec![value("obs", &[1, 1]), value("h_in", &[1, 1, 1])],
        vec![
            node("Add", &["obs", "h_in"], &["h_out"]),
            node("Reshape", &["h_out", "shape"], &["actions"]),
        ],
        vec![lads_compiler::onnx::TensorProto {
            dims: vec![2],
            data_type: 7,
            name: "shape".into(),
            int64_data: vec![1, 1],
            ..Default::default()
        }],
        vec![value("actions", &[1, 1]), value("h_out", &[1, 1, 1])],
    );
    let robot = format!("{HEAD}[[term]]\nname = \"a\"\n{SENSOR}{}", wide_action(1));
    let case = Case::new(&graph, &robot);
    let told = case.refused();
    assert!(
        told.contains("action.output") && told.contains("h_out"),
        "{told}"
    );
    assert!(told.contains("`input` it is a part of"), "{told}");
    let imported = case
        .import_with(|request| {
            request.output = Some("actions");
            request.states = vec![("h_in".into(), "h_out".into())];
        })
        .unwrap_or_else(|error| panic!("{error}"));
    let one = || step(&[&[2.0]]);
    let actions = common::run(&imported.bundle, &[one(), one(), Reset, one()]);
    close(&actions.concat(), &[2.0, 4.0, 2.0]);
}

#[test]
fn an_encoder_and_a_policy_become_one() {
    let encoder = model(
        vec![value("past", &[1, 2])],
        vec![node("MatMul", &["past", "w"], &["latent"])],
        vec![weight("w", &[2, 1], &[1.0, 10.0])],
        vec![value("latent", &[1, 1])],
    );
    let robot = format!(
        "{HEAD}history = {{ layout = \"time\", order = \"newest_first\", start = \"zero\" }}\n\
         [[term]]\nname = \"a\"\ninput = \"encoder:past\"\nwidth = 1\nhistory = 2\n{SENSOR}\
         [[term]]\nname = \"latent\"\ninput = \"policy:obs\"\nfrom = \"output:encoder:latent\"\n\
         [[term]]\nname = \"a\"\ninput = \"policy:obs\"\nwidth = 1\nscale = 3\n{}",
        wide_action(2).replace("[action]", "[action]\noutput = \"policy:actions\"")
    );
    let case = Case::new(&mirror(2), &robot);
    case.put("encoder.onnx", &prost::Message::encode_to_vec(&encoder));
    let path = case.path("encoder.onnx");
    let imported = case
        .import_with(|request| request.models.push(&path))
        .unwrap_or_else(|error| panic!("{error}"));
    let actions = common::run(&imported.bundle, &[step(&[&[1.0]]), step(&[&[2.0]])]);
    close(&actions[1], &[12.0, 6.0]);

    // The whole input of the second from the first.
    let robot = format!(
        "{HEAD}[[term]]\nname = \"a\"\nwidth = 2\n{SENSOR}{}",
        wide_action(1).replace("[action]", "[action]\noutput = \"policy:actions\"")
    );
    let case = Case::new(&mirror(1), &robot);
    case.put("encoder.onnx", &prost::Message::encode_to_vec(&encoder));
    let path = case.path("encoder.onnx");
    let imported = case
        .import_with(|request| {
            request.models.push(&path);
            request.wires = vec![("latent".into(), "policy:0".into())];
        })
        .unwrap_or_else(|error| panic!("{error}"));
    let actions = common::run(&imported.bundle, &[step(&[&[1.0, 2.0]])]);
    close(&actions[0], &[21.0]);
}

#[test]
fn commands_are_a_channel_of_their_own() {
    let robot = format!(
        "{HEAD}[[term]]\nname = \"base_ang_vel\"\nmin = -9\nmax = 9\n\
         [[term]]\nname = \"velocity_commands\"\nelements = [\"x\", \"y\"]\nunit = \"m/s\"\nscale = 2\nmin = -1\nmax = 1\n{}",
        wide_action(5)
    );
    let case = Case::new(&mirror(5), &robot);
    let actions = case.actions(&[step(&[&[1.0, 2.0, 3.0], &[0.5, -0.5]])]);
    close(&actions[0], &[1.0, 2.0, 3.0, 1.0, -1.0]);
}

#[test]
fn a_policy_that_computes_nothing_is_refused() {
    let robot = format!(
        "{HEAD}[[term]]\nname = \"a\"\nwidth = 1\n{SENSOR}[[term]]\nname = \"b\"\nwidth = 1\nchannel = \"other\"\n{SENSOR}{}",
        wide_action(2)
    );
    let told = Case::new(&mirror(2), &robot).refused();
    assert!(told.contains("it computes nothing"), "{told}");
}

#[test]
fn terms_are_told_apart_by_their_whole_names() {
    let robot = format!(
        "{HEAD}[[term]]\nname = \"arm.x\"\nwidth = 1\n{SENSOR}[[term]]\nname = \"arm\"\nwidth = 1\nscale = 3\n{SENSOR}{}",
        wide_action(2)
    );
    let case = Case::new(&mirror(2), &robot);
    let actions = case.actions(&[step(&[&[1.0, 2.0]])]);
    close(&actions[0], &[1.0, 6.0]);
}

#[test]
fn named_axes_have_the_length_that_is_said() {
    let mut graph = model(
        vec![value("obs", &[1, -1, 2])],
        vec![
            node("Reshape", &["obs", "shape"], &["flat"]),
            node("Neg", &["flat"], &["actions"]),
        ],
        vec![lads_compiler::onnx::TensorProto {
            dims: vec![2],
            data_type: 7,
            name: "shape".into(),
            int64_data: vec![1, 6],
            ..Default::default()
        }],
        vec![value("actions", &[1, 6])],
    );
    let shape = graph.graph.as_mut().expect("a graph").input[0]
        .r#type
        .as_mut();
    let shape = shape
        .expect("a type")
        .tensor_type
        .as_mut()
        .expect("a tensor");
    shape.shape.as_mut().expect("a shape").dim[1].dim_param = Some("T".into());
    let robot = format!(
        "{HEAD}history = {{ length = 3, layout = \"time\", order = \"oldest_first\", start = \"zero\" }}\n\
         [axes]\nT = 3\n[[term]]\nname = \"a\"\nwidth = 2\n{SENSOR}{}",
        wide_action(6)
    );
    let case = Case::new(&graph, &robot);
    let actions = case.actions(&[step(&[&[1.0, 2.0]]), step(&[&[3.0, 4.0]])]);
    close(&actions[1], &[0.0, 0.0, -1.0, -2.0, -3.0, -4.0]);
    let told = Case::new(&graph, &robot.replace("T = 3", "")).refused();
    assert!(told.contains("`axes.T = LENGTH`"), "{told}");
}
