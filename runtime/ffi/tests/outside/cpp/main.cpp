// A C++17 program of a user of the installed library, built without exceptions and RTTI.
// usage: user IMAGE; exits with the number of what failed, 0 for nothing.
#include <lads.hpp>

#include <array>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <vector>

int main(int count, char **arguments) {
    if (count != 2) {
        return 2;
    }
    std::ifstream file(arguments[1], std::ios::binary);
    const std::vector<char> bytes{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
    // A vector's memory starts on a boundary of 16 bytes, which is enough for an image.
    const lads::Span<const std::uint8_t> image(reinterpret_cast<const std::uint8_t *>(bytes.data()), bytes.size());

    lads::Policy policy;
    if (policy.open(image.size() == 0 ? image : lads::Span<const std::uint8_t>(image.data(), 3)) !=
        LADS_STATUS_IMAGE_TRUNCATED) {
        return 3;
    }
    lads::Controller controller;
    if (controller.allocate(policy) != LADS_STATUS_NOT_SET_UP || controller.reset() != LADS_STATUS_NULL) {
        return 4;
    }
    if (auto status = policy.open(image); !status) {
        std::fprintf(stderr, "open: %s\n", status.text());
        return 1;
    }
    auto options = lads::made<lads_options>();
    options.fallback = LADS_FALLBACK_DECAY;
    options.decay_s = 0.5F;
    if (auto status = controller.allocate(policy, options); !status) {
        std::fprintf(stderr, "allocate: %s\n", status.text());
        return 1;
    }
    if (auto status = controller.self_test(); !status) {
        std::fprintf(stderr, "self-test: %s\n", status.text());
        return 1;
    }
    // A set-up that is refused leaves what runs alone.
    auto wrong_options = options;
    wrong_options.flags |= 1U << 20;
    if (controller.allocate(policy, wrong_options) || controller.use(policy, nullptr, 0) || controller.get() == nullptr) {
        return 10;
    }
    auto known = lads::made<lads_instruction>();
    if (!policy.instruction(0, known) || !controller.set_instruction(lads::view(known.id)) ||
        controller.set_instruction("make tea") != LADS_STATUS_UNKNOWN_INSTRUCTION) {
        return 5;
    }
    const lads_contract &contract = policy.contract();
    std::vector<float> observation(contract.observation_len);
    for (std::size_t i = 0; i < observation.size(); ++i) {
        auto element = lads::made<lads_element>();
        if (!policy.observation(i, element)) {
            return 6;
        }
        observation[i] = element.min + (element.max - element.min) / 2;
    }
    std::vector<float> action(contract.action_len);
    for (std::uint64_t t = 1; t <= 100; ++t) {
        if (auto status = controller.step(observation, action, lads::tick(t)); !status) {
            std::fprintf(stderr, "step: %s\n", status.text());
            return 1;
        }
    }
    auto report = lads::made<lads_report>();
    if (controller.step(lads::Span<const float>(), action, &report) != LADS_STATUS_NO_OBSERVATION || report.stepped != 0) {
        return 7;
    }
    std::array<float, 1> wrong{};
    if (controller.step(observation, wrong) != LADS_STATUS_ACTION_LENGTH) {
        return 8;
    }
    auto counters = lads::made<lads_counters_t>();
    if (!controller.counters(counters) || counters.policy != 100 || counters.no_observation != 1) {
        return 9;
    }
    const auto name = lads::view(contract.environment);
    std::printf("%.*s: %d steps\n", static_cast<int>(name.size()), name.data(), static_cast<int>(counters.policy));
    return 0;
}
