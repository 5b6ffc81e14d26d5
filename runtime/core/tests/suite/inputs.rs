//! Tests that values given for the channels of a step match the contract, or the step is refused.

use crate::support;
use crate::support::with_controller;
use lads_core::{ChannelId, Data, InputError, StepError};

#[test]
fn what_is_given_has_to_be_what_the_contract_says() {
    let image = support::shapes::camera().image();
    with_controller(&image, |controller| {
        let [floats, bytes, gear, ticks] = [
            Data::F32(&[0.1, 0.2]),
            Data::U8(&[1, 2, 3, 4]),
            Data::I32(&[3]),
            Data::I32(&[-4, 4]),
        ];
        let sound = [floats, bytes, gear, ticks];
        let ids = [0, 2, 3, 4].map(ChannelId);
        let mut action = [7.0; 2];
        let mut step = |data: [Data; 4], ids: [ChannelId; 4]| {
            let given: [_; 4] = std::array::from_fn(|i| (ids[i], data[i]));
            controller.step_with(&given, &mut action).map(|_| ())
        };
        let refused = |error| Err(StepError::Input(error));
        let with = |at: usize, data| {
            let mut changed = sound;
            changed[at] = data;
            changed
        };
        assert_eq!(
            step(with(1, Data::F32(&[0.0; 4])), ids),
            refused(InputError::Type { channel: 2 })
        );
        assert_eq!(
            step(with(3, Data::U8(&[0; 2])), ids),
            refused(InputError::Type { channel: 4 })
        );
        let short = InputError::Length {
            channel: 2,
            got: 3,
            needed: 4,
        };
        assert_eq!(step(with(1, Data::U8(&[0; 3])), ids), refused(short));
        let outside = |channel, index, value, [min, max]: [f32; 2]| InputError::OutOfLimits {
            channel,
            index,
            value,
            min,
            max,
        };
        assert_eq!(
            step(with(2, Data::I32(&[4])), ids),
            refused(outside(3, 0, 4.0, [0.0, 3.0]))
        );
        assert_eq!(
            step(with(2, Data::I32(&[-1])), ids),
            refused(outside(3, 0, -1.0, [0.0, 3.0]))
        );
        let far = outside(4, 1, i32::MIN as f32, [-4.0, 4.0]);
        assert_eq!(step(with(3, Data::I32(&[0, i32::MIN])), ids), refused(far));
        let unknown = |channel| refused(InputError::Unknown { channel });
        for wrong in [1, 2, 9, u32::MAX] {
            let mut ids = ids;
            ids[2] = ChannelId(wrong);
            assert_eq!(step(sound, ids), unknown(wrong), "{wrong}");
        }
        assert_eq!(
            controller
                .step_with(&[(ids[0], floats)], &mut action)
                .map(|_| ()),
            refused(InputError::Missing { channel: 2 })
        );
        assert_eq!(
            controller.step_with(&[], &mut action).map(|_| ()),
            refused(InputError::Missing { channel: 0 })
        );
        assert_eq!(
            (action, controller.last_action()),
            ([7.0; 2], &[0.0; 2][..])
        );
        // Whatever was refused left no trace: the next step is a fresh controller's first.
        let given: [_; 4] = std::array::from_fn(|i| (ids[i], sound[i]));
        controller
            .step_with(&given, &mut action)
            .expect("it is sound");
        with_controller(&image, |fresh| {
            let mut first = [7.0; 2];
            fresh.step_with(&given, &mut first).expect("it is sound");
            assert_eq!(first, action);
        });
        let error = outside(4, 1, 9.0, [-4.0, 4.0]);
        assert_eq!((error.channel(), error.element()), (4, Some(1)));
        assert_eq!((short.channel(), short.element()), (2, None));
    });
}

#[test]
fn given_noise_is_finite_and_as_long_as_the_step_that_draws_most() {
    with_controller(&support::shapes::denoise().image(), |controller| {
        let mut refused = |noise: &[f32]| {
            let given = [
                (ChannelId(0), Data::F32(&[0.0; 2])),
                (ChannelId(support::shapes::NOISE), Data::F32(noise)),
            ];
            controller
                .step_with(&given, &mut [0.0; 2])
                .expect_err("it is refused")
        };
        let channel = support::shapes::NOISE;
        assert_eq!(
            refused(&[0.0; 2]),
            StepError::Input(InputError::Length {
                channel,
                got: 2,
                needed: 8
            })
        );
        let mut draws = [0.0; 8];
        draws[7] = f32::INFINITY;
        assert_eq!(
            refused(&draws),
            StepError::Input(InputError::NotFinite { channel, index: 7 })
        );
    });
}
