"""The person's model: before training it is the body, and gradients stay finite and alive."""

import numpy as np
import pytest
import torch
import trimesh

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import DA_POSE, Body
from stages.avatar.model import decoders
from stages.avatar.model.human import SCALE_RANGE, HumanModel
from stages.avatar.model.person import bone_transforms, pose, rest
from stages.avatar.model.skin import even_skin
from tests.made.skin import on_vertices


@pytest.fixture
def person(small_body):
    """A small body, its joints, and the untrained model of it."""
    body = Body(small_body())
    betas = torch.linspace(-1, 1, 10)
    vertices, _ = body(betas, torch.zeros(1, 3), DA_POSE[None], torch.zeros(1, 3))
    model = HumanModel(
        on_vertices(vertices[0], torch.as_tensor(small_body().faces), body.lbs_weights),
        channels=4,
        resolution=16,
        generator=torch.Generator().manual_seed(0),
    )
    return body, body.rest(betas)[1], vertices[0], model


def at_rest(body, joints, canonical):
    return rest(canonical, bone_transforms(joints, body.parents, torch.zeros(3), DA_POSE))


def disturb(model):
    """Networks that say something, as after training."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for network in (model.decoders.appearance, model.decoders.geometry, model.decoders.deformation):
            network[-1].weight += 0.1 * torch.randn(network[-1].weight.shape, generator=generator)


def test_before_training_it_is_the_body(person):
    body, _, vertices, model = person
    canonical, stray, _ = model()
    assert torch.equal(canonical.means[: len(vertices)], vertices) and stray.item() == 0
    assert torch.allclose(canonical.weights[: len(vertices)], body.lbs_weights, atol=3e-3)
    assert torch.allclose(
        canonical.rotations @ canonical.rotations.mT, torch.eye(3).expand_as(canonical.rotations), atol=1e-5
    )
    assert (canonical.scales > 0).all() and torch.allclose(canonical.opacities, torch.tensor(0.8))


def test_e14_the_canonical_pose_moves_nothing(person, held):
    body, joints, _, model = person
    disturb(model)
    canonical, *_ = model()
    bones = bone_transforms(joints, body.parents, torch.zeros(3), DA_POSE)
    splats = pose(at_rest(body, joints, canonical), bones, torch.zeros(3))
    held((splats.means - canonical.means).abs().max(), 1e-6)
    held((splats.axes - canonical.rotations * canonical.scales[:, None]).abs().max(), 1e-6)


def test_vertices_follow_the_body(person, small_body):
    _, _, _, model = person
    body = Body(small_body(posedirs=False))
    betas = torch.linspace(-1, 1, 10)
    canonical_vertices, _ = body(betas, torch.zeros(1, 3), DA_POSE[None], torch.zeros(1, 3))
    orient, body_pose, transl = (
        torch.tensor([0.3, -1, 0.2]),
        0.4 * torch.sin(torch.arange(69.0)),
        torch.tensor([1.0, 2, 3]),
    )
    posed, _ = body(betas, orient[None], body_pose[None], transl[None])
    canonical, *_ = model()
    n = len(canonical_vertices[0])
    exact = canonical._replace(
        means=canonical_vertices[0],
        weights=body.lbs_weights,
        **{k: getattr(canonical, k)[:n] for k in ("rotations", "scales", "opacities", "sh")},
    )
    bones = bone_transforms(body.rest(betas)[1], body.parents, orient, body_pose)
    assert torch.allclose(pose(at_rest(body, body.rest(betas)[1], exact), bones, transl).means, posed[0], atol=1e-4)


def test_d04_d14_pose_gradient_at_rest_and_at_a_half_turn_is_finite_and_not_zero(person):
    body, joints, _, model = person
    for angle in (0.0, 3.14159265):
        orient = torch.tensor([0.0, angle, 0], requires_grad=True)
        body_pose = torch.zeros(69, requires_grad=True)
        splats = pose(
            at_rest(body, joints, model()[0]), bone_transforms(joints, body.parents, orient, body_pose), torch.zeros(3)
        )
        (splats.means.square().sum() + splats.axes.square().sum()).backward()
        for grad in (orient.grad, body_pose.grad):
            assert grad.isfinite().all() and grad.abs().sum() > 1e-4


def test_gradients_of_the_first_step_reach_every_network(person):
    _, _, _, model = person
    canonical, stray, shy = model()
    (sum(t.square().sum() for t in canonical) + stray + shy).backward()
    for name, p in model.named_parameters():
        assert p.grad is not None and p.grad.isfinite().all(), name
        if name.endswith("bias") and name.split(".")[2] == str(len(getattr(model.decoders, name.split(".")[1])) - 1):
            assert p.grad.abs().sum() > 0, name


def test_d12_a_cube_starts_with_rotations_though_its_sides_face_along_the_axes(held):
    """Normals of exactly +z, -z and 0: the smallest turn from z to them is 0/0 in the usual formula."""
    cube = torch.tensor(np.array(trimesh.creation.box().triangles)).float().reshape(-1, 3)  # each side by itself
    both = torch.tensor([[5.0, 5, 5], [6, 5, 5], [5, 6, 5]])  # a triangle that faces both ways, and so nowhere
    vertices = torch.cat([cube, both])
    faces = torch.cat([torch.arange(len(vertices)).view(-1, 3), torch.tensor([[38, 37, 36]])])
    sizes = {"channels": 2, "resolution": 8, "generator": torch.Generator().manual_seed(0)}
    model = HumanModel(even_skin(vertices, faces, torch.eye(24)[:1].repeat(len(vertices), 1), 200), **sizes)
    z = model.rotations[..., 2]
    assert (z == torch.tensor([0.0, 0, -1])).all(1).any()
    assert (model.rotations[model.xyz[:, 0] > 4] == torch.eye(3)).all() and (model.xyz[:, 0] > 4).any()
    held((model.rotations @ model.rotations.mT - torch.eye(3)).abs().max(), 1e-6)
    canonical, *_ = model()
    sum(t.square().sum() for t in canonical).backward()
    assert all(p.grad.isfinite().all() for p in model.parameters())


def test_untaught_is_the_person_as_it_began(person):
    _, _, _, model = person
    model.sh_starts.copy_(torch.rand(len(model), 3))
    before = model()[0]
    disturb(model)
    with torch.no_grad():
        model.xyz += 0.1
    for a, b in zip(model.initial(), before, strict=True):
        assert torch.allclose(a, b, atol=1e-6)
    assert not torch.allclose(model()[0].means, before.means)


def say(model, network: str, columns: slice, value: float):
    """Let the last layer of a network say `value` to every Gaussian, whatever its features."""
    with torch.no_grad():
        getattr(model.decoders, network)[-1].weight[columns] = 0
        getattr(model.decoders, network)[-1].bias[columns] = value


@pytest.mark.parametrize("said", [-50.0, -10.0, -6.0, -0.7518, -1e-3, 0.0, 3.0, 50.0])
def test_a05_scales_are_positive_and_alive_whatever_the_network_says(person, said, held):
    """GELU is negative down to -0.17 and flat beyond; here the logarithm of a scale is bounded, with a slope everywhere."""
    _, _, _, model = person
    say(model, "geometry", slice(9, 12), said)
    scales = model()[0].scales
    start = model.initial().scales
    assert (scales > 0).all() and ((scales - start) * said >= 0).all()
    held((scales / start).log().abs().max(), SCALE_RANGE * (1 + 1e-5))
    scales.log().sum().backward()
    slope = model.decoders.geometry[-1].bias.grad[9:] / len(model)
    assert (slope > 1e-4).all(), "of the logarithm, so it does not depend on the unit"


@pytest.mark.parametrize("said", [-1e4, 1e4, 20.0])
def test_e01_skinning_logits_of_any_size_are_weights(person, said):
    """exp(x / 0.1) overflows float32 from 8.88 on."""
    _, _, _, model = person
    say(model, "deformation", slice(5, 7), said)
    weights = model()[0].weights
    weights.square().sum().backward()
    assert weights.isfinite().all() and torch.allclose(weights.sum(1), torch.ones(len(weights)), atol=1e-6)
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


def test_c08_half_precision_stays_inside_hidden_layers(person, monkeypatch):
    _, _, _, model = person
    disturb(model)
    results = []
    for fast in (True, False):
        monkeypatch.setattr(decoders, "FAST", fast)
        model.zero_grad()
        canonical, *_ = model()
        sum(t.square().sum() for t in canonical).backward()
        results.append((canonical, [p.grad for p in model.parameters()]))
    (half, grads), (whole, _) = results
    assert all(t.dtype == torch.float32 for t in (*half, *grads, *model.parameters()))
    assert all(g.isfinite().all() for g in grads)
    assert not torch.equal(half.means, whole.means), "the hidden layers were in bfloat16"
    assert (half.means - whole.means).norm() < 0.05 * (whole.means - model.xyz).norm(), (
        "in which they lose 3 digits of 8"
    )
    adam = torch.optim.Adam(model.parameters(), eps=1e-15)
    adam.step()
    assert all(s["exp_avg_sq"].dtype == torch.float32 for s in adam.state.values())


@pytest.mark.parametrize("height", [1.2, 1.8, 2.4])
def test_f01_the_box_fits_bodies_of_every_size(person, height):
    body, _, vertices, _ = person
    scaled = vertices * height
    model = HumanModel(
        on_vertices(scaled, torch.arange(60).reshape(20, 3), body.lbs_weights),
        channels=2,
        resolution=8,
        generator=torch.Generator().manual_seed(0),
    )
    with torch.no_grad():
        model.xyz[0] += 20
    canonical, stray, _ = model()
    (canonical.means.sum() + stray).backward()
    assert stray > 0 and model.xyz.grad.isfinite().all()


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_e02_a_joint_at_weight_0_can_come_back(person, gap):
    """Also against a logit that is larger by 1, which leaves the others 4.5e-5. float32 is flat from 10 on."""
    _, _, _, model = person
    say(model, "deformation", slice(5, 6), gap)
    target = torch.zeros(len(model), 24)
    target[:, 7] = 1
    adam = torch.optim.Adam(model.decoders.deformation.parameters(), lr=2e-3)
    first = None
    for _ in range(150):
        loss = 1000 * (model()[0].weights - target).square().mean()
        first = first or loss.item()
        adam.zero_grad()
        loss.backward()
        adam.step()
    assert loss.item() < 0.2 * first


def test_e16_view_dependent_colour_turns_with_the_body(person, held):
    body, joints, _, model = person
    disturb(model)
    canonical, *_ = model()
    higher = 0.1 * torch.randn(len(model), 3, 3, generator=torch.Generator().manual_seed(2))
    canonical = canonical._replace(sh=torch.cat([canonical.sh, higher], 1))
    turn = torch.tensor([0.0, 1.3, 0])
    resting = at_rest(body, joints, canonical)
    still = pose(resting, bone_transforms(joints, body.parents, torch.zeros(3), DA_POSE), torch.zeros(3))
    turned = pose(resting, bone_transforms(joints, body.parents, turn, DA_POSE), torch.zeros(3))
    camera = torch.tensor([0.5, 0.3, 3.0])
    pelvis = joints[0]
    moved = matrix_from_rotvec(turn) @ (camera - pelvis) + pelvis
    held((still.colors(camera) - turned.colors(moved)).abs().max(), 5e-7)
    assert not torch.allclose(still.colors(camera), turned.colors(camera), atol=1e-3)
